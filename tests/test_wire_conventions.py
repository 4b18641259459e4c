"""dbc/CONVENTIONS.md against what it describes: every table and every example in it is checked here."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Message
from test_wire_independent import LAYOUT, bitwise_crc, encode

from firmware_py.codec import load_codec
from firmware_py.core import estimator, health, kalman, manoeuvre, speed, supervisor
from firmware_py.core.signals import QUALITY_FIXED
from sim.data_files import PARAMETERS, load_course, load_vehicle, shipped_names

DBC_FOLDER = Path(__file__).resolve().parent.parent / "dbc"
DBC = DBC_FOLDER / "parking.dbc"
TEXT = (DBC_FOLDER / "CONVENTIONS.md").read_text(encoding="ascii")
MESSAGES: dict[str, Message] = {m.name: m for m in cantools.database.load_file(DBC).messages}
CODEC = load_codec(DBC)


def table(header: str) -> list[list[str]]:
    """Return the cells of the table whose header line is given, without header and ruler."""
    lines = TEXT.splitlines()
    assert lines.count(header) == 1, f"{lines.count(header)} tables have the header {header}"
    rows = []
    for line in lines[lines.index(header) + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    assert rows
    return rows


def section(title: str) -> str:
    return TEXT.partition(f"## {title}\n")[2].partition("\n## ")[0]


# -------------------------------------------------------------------------------------------------- the message table


def test_the_message_table_is_the_dbc_s() -> None:
    rows = table("| id | message | from | to | period ms | timeout ms | says |")
    told = [(row[0], row[1], row[2], set(row[3].split(", ")), int(row[4]), int(row[5])) for row in rows]
    true = [
        (
            f"0x{m.frame_id:03X}",
            m.name,
            m.senders[0],
            m.receivers,
            m.cycle_time,
            CODEC.messages[m.name].timeout_ms,
        )
        for m in sorted(MESSAGES.values(), key=lambda m: m.frame_id)
    ]
    assert told == true
    assert all(row[6] for row in rows)


def test_only_messages_signals_and_names_that_exist_are_spoken_of() -> None:
    known = set(MESSAGES) | {s.name for m in MESSAGES.values() for s in m.signals}
    spoken = set(re.findall(r"\b(?:CTRL|VEH|LOC|OPER)_[A-Za-z]+\b", TEXT))
    assert spoken - known == set()
    assert set(MESSAGES) - spoken == set()
    quoted = set(re.findall(r"`([a-z0-9]+(?:_[a-z0-9]+)+)`", TEXT))
    course_words = {"front_bumper_x", "reference_point", "rear_axle", "centre_of_gravity", "rear_bumper_x"}
    course_words |= {"cone_radius_m", "x_m", "y_m", "can_frame"}
    assert quoted - known - set(PARAMETERS) - course_words == set()


def test_reasons_and_states_are_those_of_the_value_tables() -> None:
    names = {str(choice) for m in MESSAGES.values() for s in m.signals if s.choices for choice in s.choices.values()}
    words = set(re.findall(r"\b(?:[A-Z][a-z]+){2,}\b", TEXT))
    not_names = words - names - {"SocketCAN", "ReportTimeout"}
    message_parts = {part for name in MESSAGES for part in name.split("_")} | {"GenMsgCycleTime", "GenMsgTimeout"}
    message_parts |= {"DataId"}
    assert {word for word in not_names if not any(word in part for part in message_parts)} == set()
    for reason in MESSAGES["VEH_SysRpt"].get_signal_by_name("vehicle_reason").choices.values():
        assert str(reason) in section("6. States and handshake"), f"when does a vehicle report {reason}?"


# ----------------------------------------------------------------------------------------- frames, CRC and counters


def example_rows() -> list[list[str]]:
    return table("| message | counter | signals (all others 0) | frame |")


@pytest.mark.parametrize("row", example_rows(), ids=lambda row: f"{row[0]} {row[1]}")
def test_the_worked_frames_are_right(row: list[str]) -> None:
    """Three ways: bits by hand, the firmware's codec, cantools."""
    name, counter, signals, frame = row[0], int(row[1]), row[2], bytes.fromhex(row[3].strip("`"))
    values = {key: float(value) for key, value in (part.split(" ") for part in signals.split(", "))}
    scales = {field.name: field.scale for field in LAYOUT[name][1]}
    assert encode(name, {key: round(value / scales[key]) for key, value in values.items()}, counter)[1] == frame
    struct = CODEC.messages[name].struct
    assert CODEC.pack[name](struct(**{f: values.get(f, 0) for f in struct._fields}), counter, None) == frame
    decoded = MESSAGES[name].decode(frame, decode_choices=False)
    assert {key: decoded[key] for key in values} == pytest.approx(values, abs=1e-9)
    assert all(decoded[s.name] == 0 for s in MESSAGES[name].signals if s.name not in values and name not in s.name)


def test_the_crc_s_worked_steps_are_right() -> None:
    covered = bytes.fromhex(re.search(r"after each\s+byte of `([0-9a-f ]+)` is", TEXT)[1])  # type: ignore[index]
    steps = bytes.fromhex(re.search(r"is `([0-9a-f ]+)`, so byte 0 is `dd`", TEXT)[1])  # type: ignore[index]
    assert len(covered) == len(steps) == 9
    for count in range(1, 10):
        assert bitwise_crc(list(covered[:count])) == steps[count - 1]
    assert bytes([steps[-1]]) + covered[2:] == bytes.fromhex(example_rows()[0][3].strip("`"))


def test_the_crc_as_written_computes_the_worked_frames() -> None:
    """The lines of the text, taken as the program that they nearly are."""
    for row in example_rows():
        frame = bytes.fromhex(row[3].strip("`"))
        frame_id = MESSAGES[row[0]].frame_id
        crc = 0
        for byte in (frame_id & 0xFF, frame_id >> 8, *frame[1:]):
            crc = crc ^ byte
            for _ in range(8):
                crc = (crc << 1) ^ 0x1D if crc & 0x80 else crc << 1
                crc = crc & 0xFF
        assert crc == frame[0]
    assert "crc = (crc << 1) ^ 0x1D if crc & 0x80 else crc << 1;  crc = crc & 0xFF" in TEXT
    assert "for byte in (id & 0xFF, id >> 8, data[1], ..., data[7]):" in TEXT


# -------------------------------------------------------------------------------------------------------------- hashes


def stated_hashes() -> dict[str, int]:
    return {row[0].strip("`"): int(row[1], 16) for row in table("| bytes hashed | hash |")}


def test_the_stated_hashes_are_those_of_the_shipped_files() -> None:
    true = {"parking.dbc": CODEC.dbc_hash24}
    true |= {f"vehicles/{name}.toml": load_vehicle(name).hash24 for name in shipped_names("vehicle")}
    told = {name: value for name, value in stated_hashes().items() if name.endswith((".dbc", ".toml"))}
    wanted = "\n".join(f"| `{name}` | 0x{value:06X} |" for name, value in true.items())
    assert told == true, f"section 5 of dbc/CONVENTIONS.md must say\n{wanted}"


def test_the_worked_hashes_are_right(tmp_path: Path) -> None:
    from hashlib import sha256  # noqa: PLC0415

    stated = list(stated_hashes().values())[-2:]
    text = b'name = "paper"\n'
    overlay = b"command_latency_samples=2.0\nsteering_lag_s=0.27\n"
    assert [int.from_bytes(sha256(part).digest()[:3], "big") for part in (text, text + overlay)] == stated


def test_the_overlay_is_hashed_as_described() -> None:
    from hashlib import sha256  # noqa: PLC0415

    vehicle = load_vehicle("paper", {"steering_lag_s": 0.27, "command_latency_samples": 24.0})
    file_bytes = (DBC_FOLDER / "vehicles/paper.toml").read_bytes().replace(b"\r\n", b"\n")
    digest = sha256(file_bytes + b"command_latency_samples=24.0\nsteering_lag_s=0.27\n").digest()
    assert vehicle.hash24 == int.from_bytes(digest[:3], "big")


@pytest.mark.skipif(not shutil.which("sha256sum"), reason="no sha256sum on this machine")
def test_the_shell_lines_compute_the_hashes() -> None:
    lines = [line.strip() for line in section("5. Hashes").splitlines() if "sha256sum" in line]
    assert len(lines) == 2
    answers = [
        subprocess.run(["sh", "-c", line], cwd=DBC_FOLDER, capture_output=True, text=True, check=True).stdout.strip()
        for line in lines
    ]
    vehicle = load_vehicle("paper", {"steering_lag_s": 0.27, "command_latency_samples": 24.0})
    assert answers == [f"{CODEC.dbc_hash24:06x}", f"{vehicle.hash24:06x}"]


# ----------------------------------------------------------------------------------------------------- limits, timing


def test_the_limits_are_those_of_the_controller() -> None:
    rows = {row[0]: (row[1], row[2]) for row in table("| what | limit | lasting | reason |")}
    us = 1e-6
    assert rows["measured road-wheel angle against the nominal actuator's"] == (
        f"{health.STEERING_GAP_RAD:.2f} rad",
        f"{health.STEERING_GAP_US * us:g} s",
    )
    assert rows["faster than planned at the car's place, while driving"] == (
        f"{health.SPEED_GAP_MPS:.2f} m/s",
        f"{health.SPEED_GAP_US * us:g} s",
    )
    assert rows["no motion, while asked to drive"] == (f"{health.STUCK_MPS:g} m/s", f"{health.STUCK_US * us:g} s")
    assert health.ROLLING_MPS == health.WRONG_DIRECTION_MPS
    assert rows["speed against the direction of the leg, or any while to be held"] == (
        f"{health.WRONG_DIRECTION_MPS:g} m/s",
        f"{health.WRONG_DIRECTION_US * us:g} s",
    )
    over = f"{health.OVER_SPEED_SHARE:g} x `max_speed_mps` + {health.OVER_SPEED_MPS:g} m/s"
    assert rows["speed"] == (over, "at once")
    assert rows["pose against its prediction"] == (
        f"{estimator.GATE_CROSS_M:.2f} m along or across, or {estimator.GATE_HEADING_RAD:g} rad",
        f"{health.JUMPS_IN_A_ROW} poses in a row",
    )
    assert rows["distance from the path"][0] == (
        f"{health.OFF_PATH_M:.2f} m or {health.OFF_PATH_HEADING_RAD:.2f} rad, "
        f"or {health.BEYOND_END_M:.2f} m past its end"
    )
    assert rows["cycles of its own that it skipped"][0] == (
        f"{health.OVERRUNS_AT_ONCE} in one stall, {health.OVERRUN_BUCKET} together"
    )
    assert (
        rows["`sys_cmd_timeout`, `steer_cmd_timeout` or `long_cmd_timeout` set"][1] == f"{health.REJECTED_US * us:g} s"
    )


def test_the_other_figures_are_those_of_the_controller() -> None:
    flat = " ".join(TEXT.split())
    arming = f"within {health.START_POSITION_M:.2f} m and {health.START_HEADING_RAD:.3f} rad of the start pose"
    assert arming in flat
    assert f"speed below {health.STANDSTILL_MPS:g} m/s" in flat
    assert f"averages {health.SETTLED_POSES} poses at standstill" in flat
    assert f"not Active {supervisor.ENABLE_TIMEOUT_US * 1e-6:g} s after the request" in flat
    assert f"`enable_request` 0 for {supervisor.CLEAR_PULSE_US * 1e-6:g} s" in flat
    assert f"`gear_change_s` and {manoeuvre.GEAR_PATIENCE_US * 1e-6:g} s more" in flat
    assert f"more than {kalman.SLOW_NOISE_M * 1e3:g} mm, steps 6 and 8 take {manoeuvre.SETTLE_US * 1e-6:g} s" in flat
    assert f"(white noise of {kalman.UNKNOWN_SIGMA_M * 1e2:g} cm is assumed)" in flat
    assert f"above {health.POSITION_SIGMA_MAX_M:g} the pose counts as poor" in flat
    assert f"`position_sigma_m` above {health.POSITION_SIGMA_MAX_M:g} |" in flat
    assert f"both enables 0, brake {speed.HOLD_DECEL_MPS2:g} m/s^2" in flat
    assert f"quality | Fixed ({QUALITY_FIXED})" in flat


def test_what_blocks_arming_is_told_whole() -> None:
    names = MESSAGES["CTRL_SysCmd"].get_signal_by_name("control_reason").choices
    assert names
    told = section("6. States and handshake").partition("In the way of arming")[2].partition("On the way")[0]
    plain = {"EmergencyStop": "oper_estop", "OperatorStop": "oper_stop", "DriverOverride": "driver override"}
    plain |= {"VehicleFault": "vehicle fault"}
    for reason in (*supervisor._BLOCKING, 7):
        name = str(names[reason])
        assert plain.get(name, name) in told, name


def test_the_plant_s_state_machine_is_the_one_described() -> None:
    from sim import drive_by_wire  # noqa: PLC0415

    assert f"braked to standstill, {drive_by_wire.BRAKE_DECEL_MPS2:g} m/s^2" in TEXT
    assert f"Protocol version: {drive_by_wire.PROTOCOL_VERSION}." in TEXT
    assert {s.name.title() for s in drive_by_wire.State} == {
        row[0] for row in table("| state | brake and drive | steering |")
    }


def test_every_signal_of_the_reports_is_described() -> None:
    told = (
        section("8. What reports must contain")
        + section("6. States and handshake")
        + section("7. What a vehicle must do")
    )
    told += section("4. Counters")
    flags = re.compile(r"(sys|steer|long)_cmd_(bad_crc|bad_counter|timeout)")
    for message in MESSAGES.values():
        if message.senders[0] in ("VEH", "LOC"):
            for item in message.signals:
                if not item.name.startswith(message.name) and not flags.fullmatch(item.name):
                    assert item.name in told, item.name


# ------------------------------------------------------------------------------------------------------------- files


def test_the_parameters_are_those_of_vehicle_files() -> None:
    told = {row[0]: row[1] for row in table("| parameter | unit | means |")}
    assert told == {name: parameter.unit for name, parameter in PARAMETERS.items()}
    assert list(told) == list(PARAMETERS)


def test_the_start_and_stop_poses_are_right() -> None:
    rows = table("| vehicle | course | start x | start y | stop x | stop y (left) |")
    assert {(row[0], row[1]) for row in rows} == {
        (vehicle, course) for vehicle in shipped_names("vehicle") for course in shipped_names("course")
    }
    for name, course_name, *numbers in rows:
        vehicle, course = load_vehicle(name), load_course(course_name)
        start, stop = course.start_pose(vehicle, "left"), course.stop_pose(vehicle, "left")
        assert [float(n) for n in numbers] == pytest.approx([start.x_m, start.y_m, stop.x_m, stop.y_m], abs=1e-9)
        assert (start.yaw_rad, stop.yaw_rad) == (0.0, 0.0)


def test_the_pose_rules_are_those_of_the_course_files() -> None:
    """The formulas of the table, computed, for every shipped vehicle and course."""
    rules = {row[0]: row[1:] for row in table("| rule | x | y |")}
    for course in map(load_course, shipped_names("course")):
        for vehicle in map(load_vehicle, shipped_names("vehicle")):
            point = getattr(course.start, "point", None)
            start_rule = f"start `{course.start.rule}`" + (f", point `{point}`" if point else "")
            scope = {**{key: getattr(vehicle, key) for key in PARAMETERS}, **course.start.model_dump()}
            start = [eval(formula, {}, scope) for formula in rules[start_rule]]
            assert start == pytest.approx(course.start_pose(vehicle)[:2])
            scope |= {**course.stop.model_dump(), "start_x": start[0], "start_y": start[1]}
            stop = [
                eval(formula.replace("start x", "start_x").replace("start y", "start_y"), {}, scope)
                for formula in rules[f"stop `{course.stop.rule}`"]
            ]
            assert stop == pytest.approx(course.stop_pose(vehicle)[:2])


def test_the_text_leads_nowhere_outside_its_folder() -> None:
    """An author with this folder alone has all that it refers to."""
    for path in re.findall(r"`((?:[\w-]+/)*[\w-]+\.(?:dbc|toml|md))`", TEXT):
        if "NAME" not in path:
            assert (DBC_FOLDER / path).is_file(), path
    for target in re.findall(r"\]\(#([^)]+)\)", TEXT):
        titles = [
            re.sub(r"[^a-z0-9 -]", "", line[3:].lower()).replace(" ", "-")
            for line in TEXT.splitlines()
            if line[:3] == "## "
        ]
        assert target in titles, target
    assert max(map(len, TEXT.splitlines())) < 260
