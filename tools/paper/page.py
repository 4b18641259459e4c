"""The page: the paper section by section, with what it says, what we computed, where it is wrong and what follows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.paper import figures, html, page_live, page_loop, page_path, page_runs
from tools.paper.loops import Loops
from tools.paper.study import Study
from tools.run_folder import write_whole

PAGE, FIGURES = "index.html", "figures"


def write(folder: Path, study: Study, loops: Loops, content: dict[str, Any], tell: Callable[[str], None]) -> None:
    """Draw all pictures into `folder`/figures and write `folder`/index.html, which holds them inlined."""
    tell("pictures")
    drawn = set(figures.draw_all(folder / FIGURES, study, loops))

    def picture(name: str, caption: str) -> str:
        return html.figure(folder / FIGURES / f"{name}.svg", caption) if name in drawn else ""

    car = "the paper's car" if study.car.is_papers else f"the vehicle {study.vehicle.name}, not the paper's own car"
    lead = (
        "X. Cao and L. Guvenc, <i>Path Planning and Robust Path Tracking Control of an Automated Parallel Parking "
        f"Maneuver</i>: every table and figure computed again, for {car}. Where the paper prints a number, ours stands "
        "beside it. Eq., Table and Figure numbers are the paper's."
    )
    sections = [
        ("summary", "What holds and what does not", page_runs.summary(study, content, picture)),
        ("path", "Path: eq. 1 to 10, Table 1, Figures 1 to 5", page_path.path(study, content, picture)),
        ("model", "Model: eq. 11, Table 2, Figure 6", page_path.model(study, content, picture)),
        ("speed", "Speed and preview: Table 3, Figure 7", page_path.speed(study, content, picture)),
        ("dob", "Disturbance observer: eq. 12 to 18, Figures 8 to 10", page_loop.observer(study, loops, picture)),
        ("sampling", "The same loop at 100 Hz", page_loop.sampling(study, loops, picture)),
        ("pid", "Parameter space: eq. 19, Figures 11 to 13", page_loop.parameter_space(study, loops, picture)),
        ("runs", "Simulations: Tables 4 to 6, Figures 14 to 19", page_runs.simulations(study, content, picture)),
        ("reverse", "Reverse with the sign put right", page_runs.reverse(study, content, picture)),
        ("controller", "The laws in the controller: Tables 5 and 6 at 100 Hz", page_live.controller(study, picture)),
        ("method", "How this was computed", page_runs.method(study, content)),
    ]
    write_whole(folder / PAGE, html.page("The paper, reproduced and corrected", lead, sections))
