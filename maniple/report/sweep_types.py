"""What a picture of a sweep shows."""

from maniple.core.scenario.types import Name, Parameters, Positive


class Plot(Parameters, frozen=True, kw_only=True):
    """One picture: a column against an axis, median and extremes over the seeds."""

    name: Name
    """Of its file."""
    x: str
    """An axis of the grid with numbers."""
    y: str
    """A column of the results with numbers, or with true and false: then the share that is true."""
    series: str = ""
    """An axis: a line for each of its values."""
    facets: str = ""
    """An axis: a panel for each of its values."""
    title: str = ""
    """Above everything."""
    x_label: str = ""
    """By default `x`."""
    y_label: str = ""
    """By default `y`."""
    series_label: str = ""
    """In front of its values in the legend; by default `series`."""
    log: bool = False
    """Whether y is drawn on a logarithmic scale."""
    log_x: bool = False
    """Whether x is."""
    y_min: Positive | None = None
    """What is smaller is drawn at this."""
    y_max: Positive | None = None
    """What is larger is drawn at this."""
    edge: Positive | None = None
    """The delay of the whole loop is this many times x: draw where it is `tolerated_delay_s`, the rule of
    thumb, and where it is `delay_margin_s`, the linearised loop."""
