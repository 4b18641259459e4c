"""Section of the page: the paper's laws in the real controller, on the emulator's eq. 11."""

from collections.abc import Callable

from tools.paper import in_lockstep
from tools.paper.firmware_law import NAMES
from tools.paper.html import OURS, SO, WRONG, note, table
from tools.paper.in_lockstep import BUS, CAR, LATE, START_M, LegRun
from tools.paper.page_loop import three
from tools.paper.plant import CORRECTED, FORWARD, PRINTED, REVERSE
from tools.paper.study import TABLE_5, TABLE_6, Study

Picture = Callable[[str, str], str]


def controller(study: Study, picture: Picture) -> str:
    """What is left of Tables 5 and 6 there, what one sample does, and the law that works beside it."""
    on_bus, late, reversed_rows = [], [], []
    for direction, printed in ((FORWARD, TABLE_5), (REVERSE, TABLE_6)):
        for law, name in NAMES.items():
            continuous = study.results[printed][name].figures
            bus, later = (
                in_lockstep.find(study.lockstep.legs, law, PRINTED, delay, direction) for delay in (BUS, LATE)
            )
            on_bus.append(
                (
                    f"{name}, {direction}",
                    three(continuous),
                    *_cells(bus),
                )
            )
            late.append((f"{name}, {direction}", _three(bus), _against(later, bus), _rate(bus), _rate(later)))
    for law, name in (*NAMES.items(), (CAR, "law of this project")):
        leg = in_lockstep.find(study.lockstep.legs, law, CORRECTED, BUS, REVERSE)
        if leg is not None:
            row = leg.row
            end = "~comes to its stop" if row.is_complete else f"!stopped after {row.travelled_m:.1f} m"
            reversed_rows.append(
                (
                    name,
                    end,
                    f"{1e3 * row.max_e_y_m:.3g}",
                    f"{1e3 * row.max_cross_track_m:.0f}",
                    f"{1e3 * row.max_rear_cross_track_m:.3g}",
                    f"{row.max_steer_rad:.2f}",
                )
            )
    of_car = [
        in_lockstep.find(study.lockstep.legs, CAR, CORRECTED, LATE, direction) for direction in (FORWARD, REVERSE)
    ]
    worst = max((1e3 * leg.row.max_rear_cross_track_m for leg in of_car if leg is not None), default=float("nan"))
    reason = next((in_lockstep.reason_text(r.row) for r in study.lockstep.legs if not r.row.is_complete), "")
    return "".join(
        [
            note(
                OURS,
                "The controller itself, its core, tables by (direction, speed), codecs and frames, against the "
                "emulator whose plant is eq. 11 (scenario <i>paper</i>): wide steering limits, no lag, a report is "
                f"{BUS.total_ms:g} ms old when its command acts. "
                "<code>parkctl demo --law paper --scenario paper</code> drives the same before your eyes.",
            ),
            table(
                "What is left of Tables 5 and 6, printed sign: max e<sub>y</sub> (mm) / rms (mm) / angle (rad)",
                (
                    "law",
                    "continuous",
                    "in the controller",
                    "max e<sub>y</sub> after the start (mm)",
                    "true error of the CG (mm)",
                ),
                on_bus,
            ),
            note(
                WRONG,
                "The paper's speeds begin at 0.1 m/s, a car's at rest. On a path with free ends, which begins bent, "
                "e<sub>y</sub> has its largest value in the first centimetres then: the table has it with and without "
                f"the first {START_M:g} m.",
            ),
            table(
                "One sample more, which the law does not know: max e<sub>y</sub> (mm) / rms (mm) / angle (rad)",
                (
                    "law",
                    f"{BUS.total_ms:g} ms",
                    f"{LATE.total_ms:g} ms",
                    f"rate at {BUS.total_ms:g} ms (rad/s)",
                    f"rate at {LATE.total_ms:g} ms (rad/s)",
                ),
                late,
            ),
            picture(
                "in_controller",
                "The controller in lock-step on eq. 11: e<sub>y</sub> and steering of PID + DOB as the bus delivers it "
                "and one sample later, forward; in reverse with the corrected sign, the true error of the three laws.",
            ),
            table(
                "Forward with one real part that no law here knows: max e<sub>y</sub> (mm) / rms (mm) / angle (rad)",
                ("eq. 11 with", *NAMES.values()),
                _parts(study),
            ),
            note(
                WRONG,
                "An observer of 100 rad/s leaves no room for a car. The PID alone hardly notices a lag, a rack's rate "
                "or tyres that build up their force over a distance; with the observer the loop swings (red: an rms "
                "more than three times that on eq. 11), or the car is stopped because its steering does not follow.",
            )
            if study.lockstep.with_part
            else "",
            table(
                "Reverse with the corrected sign, in the controller",
                (
                    "law",
                    "the reverse leg",
                    "max e<sub>y</sub> (mm)",
                    "true error of the CG (mm)",
                    "of the rear axle (mm)",
                    "angle (rad)",
                ),
                reversed_rows,
            ),
            note(
                SO,
                f"What the paper reports can be had at 100 Hz on its own plant with {BUS.total_ms:g} ms of delay. "
                f"{_one_sample(study)} The true sign ends it in reverse"
                f"{f' ({reason})' if reason else ''}. The law of this project drives the same plant both ways, "
                f"with the same extra sample within {worst:.1f} mm of its own path, that of the rear axle.",
            ),
        ]
    )


def _one_sample(study: Study) -> str:
    pairs = [
        tuple(in_lockstep.find(study.lockstep.legs, "paper", PRINTED, delay, direction) for delay in (BUS, LATE))
        for direction in (FORWARD, REVERSE)
    ]
    times = [late.row.rms_e_y_m / bus.row.rms_e_y_m for bus, late in pairs if bus is not None and late is not None]
    if not times:
        return "With one sample more PID + DOB does not come to its stop."
    return f"One sample more makes the rms e<sub>y</sub> of PID + DOB {min(times):.0f} times as large."


def _parts(study: Study) -> list[tuple[str, ...]]:
    parts: dict[str, dict[str, LegRun]] = {}
    for leg in study.lockstep.with_part:
        parts.setdefault(leg.row.part, {})[leg.row.law] = leg
    rows = []
    for part, legs in parts.items():
        plain = {law: in_lockstep.find(study.lockstep.legs, law, PRINTED, BUS, FORWARD) for law in NAMES}
        rows.append((part, *(_against(legs.get(law), plain[law]) for law in NAMES)))
    return rows


def _against(leg: LegRun | None, plain: LegRun | None) -> str:
    """The cell of a leg, marked where it is much worse than a plain one."""
    text = _three(leg)
    is_worse = leg is not None and plain is not None and leg.row.rms_e_y_m > 3.0 * plain.row.rms_e_y_m
    return f"!{text}" if is_worse and not text.startswith("!") else text


def _three(leg: LegRun | None) -> str:
    if leg is None:
        return "!did not come to it"
    return three(leg.row) if leg.row.is_complete else f"!{three(leg.row)}, stopped after {leg.row.travelled_m:.1f} m"


def _rate(leg: LegRun | None) -> str:
    return "-" if leg is None else f"{leg.row.max_steer_rate_cmd_after_start_radps:.2f}"


def _cells(leg: LegRun | None) -> tuple[str, str, str]:
    if leg is None:
        return "!did not come to it", "-", "-"
    row = leg.row
    return _three(leg), f"{1e3 * row.max_e_y_after_start_m:.3g}", f"{1e3 * row.max_cross_track_m:.0f}"
