"""Colours of robots and triangles, wherever they are drawn."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette, told apart by the colour-blind; without black and yellow."""

YELLOW = "#F0E442"
"""The one that no robot has: a robot that its guard holds."""

RED = "#E5001A"
"""A robot that stands for a bad reason."""

STONE = "#8C8C8C"
"""What is desired, or stands around."""


def rgb(colour: str) -> tuple[float, float, float]:
    """Red, green and blue, 0 to 1, of "#RRGGBB"."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red / 255, green / 255, blue / 255
