from typing import get_args

from maniple.core.layers import PIPELINE, Layer, central_layers, onboard_layers


def test_every_cut_leaves_every_layer_on_exactly_one_side() -> None:
    assert get_args(Layer) == PIPELINE
    for cut in PIPELINE:
        assert central_layers(cut) + onboard_layers(cut) == PIPELINE
        assert onboard_layers(cut)[0] == cut
