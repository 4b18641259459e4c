"""The page."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.paper.study import Study
from tools.run_folder import write_whole


def write(folder: Path, study: Study, content: dict[str, Any], tell: Callable[[str], None]) -> None:
    """Write page and pictures."""
    write_whole(folder / "index.html", "<!doctype html><title>paper</title>")
