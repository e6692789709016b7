import numpy as np
import pytest

from maniple.report.samples import Samples, Track, band, seconds, with_gaps


def test_rows_come_out_in_the_order_of_their_times() -> None:
    samples = Samples(2)
    for stamp in (30, 10, 20):
        samples.add(stamp, (float(stamp), -1.0))
    stamps, rows = samples.arrays()
    assert stamps.tolist() == [10, 20, 30]
    assert rows.tolist() == [[10.0, -1.0], [20.0, -1.0], [30.0, -1.0]]
    assert len(samples) == 3


def test_nothing_has_its_shape_too() -> None:
    stamps, rows = Samples(3).arrays()
    assert stamps.shape == (0,)
    assert rows.shape == (0, 3)


def test_times_keep_their_nanoseconds_far_from_the_epoch() -> None:
    begin = 1_800_000_000_000_000_001
    stamps = np.array([begin, begin + 1], dtype=np.int64)
    assert seconds(stamps, begin).tolist() == [0.0, 1e-9]


def test_lines_break_in_gaps() -> None:
    track = Track(np.array([0.0, 1.0, 5.0, 6.0]), np.arange(4.0).reshape(-1, 1))
    broken = with_gaps(track, 2.0)
    assert broken.t.tolist() == [0.0, 1.0, 3.0, 5.0, 6.0]
    assert np.isnan(broken.values[2, 0])
    assert broken.values[[0, 1, 3, 4], 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert with_gaps(track, 4.0) is track


def test_a_band_holds_every_sample_between_its_extremes() -> None:
    rng = np.random.default_rng(1)
    tracks = [(np.sort(rng.uniform(0, 10, 500)), rng.normal(size=500)) for _ in range(7)]
    found = band(tracks, 20)
    assert len(found.t) == 20
    assert (np.diff(found.levels, axis=0) >= 0).all()
    everything = np.concatenate([values for _, values in tracks])
    assert found.levels[0].min() == everything.min()
    assert found.levels[4].max() == everything.max()


def test_a_band_of_one_span_is_its_percentiles() -> None:
    values = np.arange(101.0)
    found = band([(np.linspace(0, 1, 101), values)], 1)
    assert found.levels[:, 0] == pytest.approx([0, 25, 50, 75, 100])


def test_a_band_leaves_out_what_is_not_known() -> None:
    t = np.arange(4.0)
    assert band([(t, np.full(4, np.nan))]).levels.shape == (5, 0)
    assert band([]).t.shape == (0,)
    assert band([(t, np.array([1.0, np.nan, np.nan, 3.0]))], 1).levels[:, 0].tolist() == [1, 1.5, 2, 2.5, 3]
