"""Bring-up of the CAN interface, dry; the systemd units; and that no restart ever arms by itself."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from firmware_py.__main__ import DEFAULT_DBC, DEFAULT_TABLES, EXIT_MISTAKE, EXIT_STOPPED, build_parser
from firmware_py.codec import Sender, load_codec
from firmware_py.core.controller import PERIOD_S, PERIOD_US
from firmware_py.core.signals import (
    GEAR_PARK,
    MODE_MANUAL,
    MODE_READY,
    Attitude,
    LongReport,
    MotionReport,
    OperatorCommand,
    Position,
    SteerReport,
    SysReport,
    VehicleVersion,
)
from firmware_py.loop import STOPPING_CYCLES
from firmware_py.node import ControllerNode, build_tables
from firmware_py.preflight import BITRATE
from firmware_py.realtime import PRIORITY
from firmware_py.table_file import load_tables

DEPLOY = Path(__file__).resolve().parent.parent / "tools" / "deploy"
CAN_UP = DEPLOY / "can_up.sh"
CODEC = load_codec(DEFAULT_DBC)
TABLES = build_tables(load_tables(DEFAULT_TABLES, "left", "car", PERIOD_S, DEFAULT_DBC.parent), CODEC)


def can_up(*options: str, path: str = "/usr/sbin:/usr/bin:/sbin:/bin") -> subprocess.CompletedProcess[str]:
    command = ["/bin/sh", str(CAN_UP), *options]
    return subprocess.run(command, capture_output=True, text=True, env={"PATH": path}, check=False, timeout=20)


# ------------------------------------------------------------------------------------------------------------ bring-up


def test_the_dry_run_shows_every_step_and_needs_nothing() -> None:
    answer = can_up("--dry-run", path="/nowhere")
    assert (answer.returncode, answer.stderr) == (0, "")
    assert answer.stdout.splitlines() == [
        "+ ip link set dev can0 down",
        f"+ ip link set dev can0 type can bitrate {BITRATE} restart-ms 100 listen-only off",
        "+ ip link set dev can0 txqueuelen 128",
        "+ ip link set dev can0 up",
        "+ ip -details -statistics link show dev can0",
        "# filters: none here; the controller's own socket passes only the ids of its DBC",
    ]


def test_every_option_arrives() -> None:
    options = ["can3", "--bitrate", "250000", "--restart-ms", "0", "--txqueuelen", "1000", "--listen-only", "--dry-run"]
    lines = can_up(*options).stdout.splitlines()
    assert lines[1:3] == [
        "+ ip link set dev can3 type can bitrate 250000 restart-ms 0 listen-only on",
        "+ ip link set dev can3 txqueuelen 1000",
    ]
    assert can_up("--down", "--dry-run").stdout == "+ ip link set dev can0 down\n"
    assert can_up("--statistics", "--dry-run").stdout == "+ ip -details -statistics link show dev can0\n"
    virtual = can_up("vcan77", "--dry-run").stdout.splitlines()
    assert virtual[0] == "+ ip link add dev vcan77 type vcan"
    assert "bitrate" not in " ".join(virtual), "a virtual interface has none"


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--bitrate", "5x"], "--bitrate 5x: must be a whole number from 10000 to 1000000"),
        (["--bitrate", "5000"], "--bitrate 5000: must be a whole number from 10000 to 1000000"),
        (["--bitrate", "99999999999999999999"], "--bitrate 99999999999999999999: must be a whole number"),
        (["--bitrate", "-1"], "--bitrate -1: must be"),
        (["--bitrate"], "--bitrate: needs a number"),
        (["--speed"], "--speed: no such option (see --help)"),
        (["can0", "can1"], "can1: one channel at a time, can0 is named already"),
        (["can0; reboot"], "can0; reboot: not the name of an interface"),
        (["a_name_that_is_too_long"], "a_name_that_is_too_long: not the name of an interface"),
        (["nocan9"], "nocan9: there is no such interface; `ip link` lists those that there are"),
    ],
)
def test_a_mistake_is_one_line(options: list[str], line: str) -> None:
    answer = can_up(*options)
    if shutil.which("ip", path="/usr/sbin:/usr/bin:/sbin:/bin") is None and "nocan9" in options:
        line = "the program ip is missing (package iproute2)"
    assert (answer.returncode, answer.stdout) == (2, "")
    assert answer.stderr.startswith(f"can_up: error: {line}")
    assert len(answer.stderr.splitlines()) == 1


def test_a_step_that_fails_ends_it_there(tmp_path: Path) -> None:
    """With a program `ip` that cannot set the bit rate, on an interface that there is."""
    program = tmp_path / "ip"
    program.write_text('#!/bin/sh\ncase "$*" in *bitrate*) exit 2;; esac\n')
    program.chmod(0o755)
    root = tmp_path / "id"
    root.write_text("#!/bin/sh\necho 0\n")
    root.chmod(0o755)
    answer = can_up("lo", path=f"{tmp_path}:/usr/bin:/bin")
    assert answer.returncode == 2
    assert answer.stdout.splitlines() == [
        "+ ip link set dev lo down",
        "+ ip link set dev lo type can bitrate 500000 restart-ms 100 listen-only off",
    ]
    assert answer.stderr.startswith("can_up: error: `ip link set dev lo type can bitrate 500000")


# --------------------------------------------------------------------------------------------------------------- units


class Unit:
    """A systemd unit's values by section and key; a key may stand more than once."""

    def __init__(self, name: str) -> None:
        parser = configparser.RawConfigParser(strict=False, interpolation=None)
        parser.optionxform = str  # type: ignore[assignment, method-assign]
        parser.read_string((DEPLOY / name).read_text())
        self.parser = parser

    def __getitem__(self, key: str) -> str:
        return next(self.parser[section][key] for section in self.parser.sections() if key in self.parser[section])


CONTROLLER = Unit("parkctl-controller@.service")
CAN = Unit("parkctl-can@.service")


def test_the_controller_gets_its_scheduling_and_memory() -> None:
    assert CONTROLLER["CPUSchedulingPolicy"] == "fifo"
    assert CONTROLLER["CPUSchedulingPriority"] == CONTROLLER["LimitRTPRIO"] == str(PRIORITY)
    assert CONTROLLER["LimitMEMLOCK"] == "infinity"
    assert CONTROLLER["AmbientCapabilities"] == CONTROLLER["CapabilityBoundingSet"] == "CAP_SYS_NICE CAP_IPC_LOCK"


def test_the_interface_is_up_before_the_controller_and_takes_it_down_with_it() -> None:
    assert CONTROLLER["Requires"] == CONTROLLER["After"] == "parkctl-can@%i.service"
    assert CONTROLLER["BindsTo"] == CAN["BindsTo"] == "sys-subsystem-net-devices-%i.device"
    assert CAN["ExecStart"] == "/opt/parkctl/bin/parkctl-can-up %i $CAN_UP_OPTIONS"
    assert can_up("can0", "--down", "--dry-run").returncode == 0
    assert CAN["ExecStop"] == "/opt/parkctl/bin/parkctl-can-up %i --down"


def test_its_command_is_one_that_the_controller_understands() -> None:
    words = CONTROLLER["ExecStart"].split()
    assert words[:4] == ["/opt/parkctl/bin/python", "-P", "-m", "firmware_py"]
    assert words[-1] == "$PARKCTL_OPTIONS"
    options = build_parser().parse_args([word.replace("%i", "can0") for word in words[4:-1]])
    assert (options.interface, options.channel, options.no_config) == ("socketcan", "can0", True)
    assert options.realtime == "required"
    assert not options.once
    assert set(re.findall(r"^(\w+)=", (DEPLOY / "controller.env").read_text(), re.M)) == {
        "PARKCTL_OPTIONS",
        "CAN_UP_OPTIONS",
    }


def test_it_is_restarted_after_a_crash_only_and_not_for_ever() -> None:
    assert CONTROLLER["Restart"] == "on-failure"
    assert CONTROLLER["RestartPreventExitStatus"] == f"{EXIT_MISTAKE} {EXIT_STOPPED}"
    assert int(CONTROLLER["StartLimitBurst"]) * float(CONTROLLER["RestartSec"]) < int(
        CONTROLLER["StartLimitIntervalSec"]
    )
    assert int(CONTROLLER["TimeoutStopSec"]) > STOPPING_CYCLES * PERIOD_S + 1.0


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing (package systemd)")
def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    program = tmp_path / "true"
    shutil.copy("/bin/true", program)
    files = []
    for name in ("parkctl-controller@", "parkctl-can@"):
        text = (DEPLOY / f"{name}.service").read_text()
        file = tmp_path / f"{name}can0.service"
        file.write_text(re.sub(r"/opt/parkctl/bin/[\w-]+", str(program), text))
        files.append(str(file))
    answer = subprocess.run(
        ["systemd-analyze", "verify", *files], capture_output=True, text=True, check=False, timeout=60
    )
    own = [line for line in answer.stderr.splitlines() if "parkctl" in line]
    assert (answer.returncode, own) == (0, []), answer.stderr


# ------------------------------------------------------------------------------------------------------ no self-arming


class Restarted:
    """A controller that has just come up on a bus where car and operator station are already talking."""

    def __init__(self) -> None:
        self.node = ControllerNode(CODEC, TABLES)
        self._sender = Sender(CODEC)
        self._cycle = 0

    def cycles(self, count: int, *, vehicle_state: int = MODE_READY, start: int = 0) -> tuple[set[int], set[int]]:
        """Run cycles; return the modes seen and the enable requests sent."""
        leg = TABLES.leg[0]
        modes, requests = set(), set()
        for _ in range(count):
            self._cycle += 1
            reports = (
                ("VEH_SysRpt", SysReport(vehicle_state, 0, 0, 0, 0, 0, 0)),
                ("OPER_Cmd", OperatorCommand(start, 0, 0, 0)),
                ("VEH_SteerRpt", SteerReport(0.0, 0.0, 1, 0, 0, 0, 0, 0, 0, 0, 0.0)),
                ("VEH_MotionRpt", MotionReport(0.0, 0.0, 1, 1)),
                ("VEH_LongRpt", LongReport(GEAR_PARK, 1, 1, 0.0, 0.0, 0, 0, 0, 0, 0)),
                ("VEH_Version", VehicleVersion(1, TABLES.dbc_hash24, TABLES.vehicle_hash24)),
                ("LOC_Position", Position(leg.x_m[0], leg.y_m[0], 3)),
                ("LOC_Attitude", Attitude(leg.yaw_rad[0], 3, 0.0, 0.0)),
            )
            frames = [self._sender.pack(name, values) for name, values in reports]
            out = self.node.cycle(self._cycle * PERIOD_US * 1000, frames, 0)
            sent = dict(out)
            command = CODEC.unpack["CTRL_SysCmd"](sent[CODEC.messages["CTRL_SysCmd"].frame_id])
            modes.add(command.control_mode)
            requests.add(command.enable_request)
        return modes, requests


def test_it_comes_up_in_manual_and_waits_for_a_start_of_its_own() -> None:
    restarted = Restarted()
    assert restarted.cycles(1) == ({MODE_MANUAL}, {0})
    modes, requests = restarted.cycles(500)
    assert (max(modes), requests) == (MODE_READY, {0}), "ready, and not a request more"
    assert 1 in restarted.cycles(2, start=1)[1], "the operator's start, pressed anew, asks for it"


def test_a_start_button_that_is_still_held_arms_nothing() -> None:
    restarted = Restarted()
    modes, requests = restarted.cycles(500, start=1)
    assert (max(modes), requests) == (MODE_READY, {0})


@pytest.mark.parametrize("vehicle_state", [2, 3], ids=["Active", "Fault"])
def test_a_car_that_the_crashed_one_left_active_or_stopped_stays_so(vehicle_state: int) -> None:
    restarted = Restarted()
    modes, requests = restarted.cycles(500, vehicle_state=vehicle_state, start=1)
    assert (modes, requests) == ({MODE_MANUAL}, {0})
