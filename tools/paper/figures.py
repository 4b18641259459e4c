"""All pictures of the study by name, drawn into a folder as SVG and PNG."""

from collections.abc import Callable
from pathlib import Path

from tools.paper.laws import BOTH, DOB, PID
from tools.paper.loops import Loops
from tools.paper.study import TABLE_5, TABLE_6, Study


def catalogue(study: Study, loops: Loops) -> dict[str, Callable[[Path], None]]:
    """Each picture's file name (without its ending) and what draws it; what a car has no result for is left out."""
    from tools.plots import paper_diagrams, paper_model, paper_path, paper_runs  # noqa: PLC0415 -- matplotlib

    pictures: dict[str, Callable[[Path], None]] = {
        "figure_01": lambda stem: paper_path.figure_1(study, stem),
        "figure_02": lambda stem: paper_path.figure_2(study, stem),
        "figure_03": lambda stem: paper_path.figure_3(study, stem),
        "figure_04": lambda stem: paper_path.figure_4(study, stem),
        "figure_05": lambda stem: paper_path.figure_5(study, stem),
        "figure_06": paper_diagrams.figure_6,
        "figure_07": lambda stem: paper_path.figure_7(study, stem),
        "figure_08": paper_diagrams.figure_8,
        "figure_09": paper_diagrams.figure_9,
        "figure_10": paper_diagrams.figure_10,
        "figure_11": lambda stem: paper_model.figure_11(loops, stem),
        "choices_m_p_q": lambda stem: paper_path.choices(study, stem),
        "swept_body": lambda stem: paper_path.rear_axle(study, stem),
        "poles_and_zeros": lambda stem: paper_model.poles_and_zeros(study, stem),
        "right_half_plane": lambda stem: paper_model.right_half_plane(study, stem),
        "equation_17": lambda stem: paper_model.equation_17(study, stem),
        "margins": lambda stem: paper_model.margins(loops, stem),
        "discretisations": lambda stem: paper_model.discretisations(loops, stem),
        "sampled_runs": lambda stem: paper_model.sampled_runs(loops, stem),
        "true_error": lambda stem: paper_runs.true_error(study, stem),
        "feedforward": lambda stem: paper_runs.feedforward(study, stem),
        "divergence": lambda stem: paper_runs.divergence(study, stem),
        "rear_axle_law": lambda stem: paper_runs.rear_axle_law(study, stem),
        "in_controller": lambda stem: paper_runs.in_controller(study, stem),
        "rates": lambda stem: paper_runs.rates(study, stem),
    }
    if study.car.is_papers:
        pictures["cells"] = lambda stem: paper_runs.cells(study, stem)
    for name, stem_name in (("figure 12", "figure_12"), ("figure 13", "figure_13")):
        if name in loops.regions:
            pictures[stem_name] = lambda stem, name=name: paper_model.admissible(loops, name, stem)  # type: ignore[misc]
    number = 14
    for table in (TABLE_5, TABLE_6):
        for law in (DOB, PID, BOTH):
            pictures[f"figure_{number}"] = lambda stem, table=table, law=law: paper_runs.simulation(
                study, table, law, stem
            )  # type: ignore[misc]
            number += 1
    return pictures


def draw_all(folder: Path, study: Study, loops: Loops) -> list[str]:
    """Draw every picture into a folder; return their names."""
    pictures = catalogue(study, loops)
    for name, draw in pictures.items():
        draw(folder / name)
    return list(pictures)
