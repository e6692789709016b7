import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from maniple.core.messages import pack_floats, unpack_floats


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    arrays.arrays(
        np.float32, arrays.array_shapes(max_dims=2, max_side=20), elements=st.floats(-1e6, 1e6, width=32)
    )
)
def test_floats_survive_the_wire(values: np.ndarray) -> None:
    columns = values.shape[1] if values.ndim == 2 else None
    back = unpack_floats(pack_floats(values), columns)
    assert back.dtype == np.float64
    assert np.array_equal(back, values)


def test_floats_are_little_endian_and_in_c_order() -> None:
    assert pack_floats([1.0]) == b"\x00\x00\x80\x3f"
    fortran = np.asfortranarray([[1.0, 2.0], [3.0, 4.0]])
    assert unpack_floats(pack_floats(fortran)).tolist() == [1.0, 2.0, 3.0, 4.0]
    assert unpack_floats(pack_floats(np.arange(3).astype(">f8"))).tolist() == [0.0, 1.0, 2.0]


def test_a_wrong_number_of_columns_is_an_error() -> None:
    with pytest.raises(ValueError, match="reshape"):
        unpack_floats(pack_floats([1.0, 2.0]), 3)
