"""All pictures are made here: the only package that imports matplotlib. It draws into files and needs no display."""

import logging

import matplotlib as mpl

mpl.use("Agg")
logging.getLogger("matplotlib").setLevel(logging.ERROR)  # building its font cache is nobody's news

from tools.plots.design import design_sheet, trade  # noqa: E402
from tools.plots.run import histogram, signals, swept_body  # noqa: E402

__all__ = ["design_sheet", "histogram", "signals", "swept_body", "trade"]
