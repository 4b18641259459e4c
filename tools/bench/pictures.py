"""Histograms of the bench's samples. The only module here that imports matplotlib; it needs no display."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
logging.getLogger("matplotlib").setLevel(logging.ERROR)
import matplotlib.pyplot as plt  # noqa: E402

BINS = 80


def histogram(file: Path, title: str, samples_us: Mapping[str, Sequence[float]]) -> None:
    """Draw one histogram a name over the same logarithmic axis in us; the file appears whole or not at all."""
    least = max(min(min(samples) for samples in samples_us.values()), 0.05)
    most = max(2.0 * least, *(max(samples) for samples in samples_us.values()))
    edges = np.geomspace(least, most, BINS)
    figure, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    for name, samples in samples_us.items():
        axes.hist(np.maximum(samples, least), bins=list(edges), histtype="step", linewidth=1.5, label=name)
    axes.set(xscale="log", yscale="log", xlabel="us", ylabel="samples", title=title)
    axes.legend()
    axes.grid(alpha=0.3)
    temporary = file.with_name(f".{file.name}")
    figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)
    temporary.replace(file)
