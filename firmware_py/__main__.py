"""Composition root of the controller process: options, tables, bus, real time, then loop or preflight. No logic."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import NoReturn

from firmware_py import preflight
from firmware_py.bus import Bus, open_bus
from firmware_py.codec import INPUT_MESSAGES, Codec, load_codec
from firmware_py.core.controller import PERIOD_S, PERIOD_US
from firmware_py.core.signals import MODE_FAULT
from firmware_py.core.tables import LAW_PAPER
from firmware_py.errors import UserError
from firmware_py.loop import Clock, Loop, RunResult, status_writer
from firmware_py.node import ControllerNode, build_tables
from firmware_py.rates import RateWatch
from firmware_py.realtime import set_up
from firmware_py.reasons import TEXT
from firmware_py.table_file import LAWS, SIDES, load_tables
from firmware_py.warm_up import warm_up

HERE = Path(__file__).resolve().parent
DEFAULT_TABLES = HERE / "tables" / "paper-ohio"
# Beside the package in the source tree, inside it where the controller alone is installed.
DBC_FOLDER = HERE / "dbc" if (HERE / "dbc").is_dir() else HERE.parent / "dbc"
DEFAULT_DBC = DBC_FOLDER / "parking.dbc"

SLOWEST_MOTION = 1000

EXIT_DONE = 0
EXIT_MISTAKE = 2
EXIT_STOPPED = 3
EXIT_INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def build_parser() -> argparse.ArgumentParser:
    """Return the options of the controller process."""
    parser = _Parser(
        prog="python -m firmware_py",
        description="The parking controller: reads and writes CAN frames every 10 ms until the manoeuvre is over.",
    )
    bus = parser.add_argument_group("bus (python-can's options; CAN_* variables and can.conf are obeyed)")
    bus.add_argument("-i", "--interface", help="python-can interface: loopbus (default), socketcan, kvaser, ...")
    bus.add_argument("-c", "--channel", help="channel of the interface: base port for loopbus, vcan0, can0, ...")
    bus.add_argument("-b", "--bitrate", type=int, help="bit rate in bit/s (500000); where the interface sets it")
    bus.add_argument("--no-config", action="store_true", help="ignore CAN_* variables and can.conf")
    parser.add_argument("--tables", type=Path, default=DEFAULT_TABLES, metavar="DIR", help="folder of the tables")
    parser.add_argument("--dbc", type=Path, default=DEFAULT_DBC, metavar="FILE", help="the DBC file")
    parser.add_argument("--side", choices=sorted(SIDES), default="left", help="side on which to pass the point cone")
    parser.add_argument("--law", choices=sorted(LAWS), default="car", help="control law")
    parser.add_argument(
        "--realtime",
        choices=("auto", "off", "required"),
        help="use of SCHED_FIFO (required on a physical interface, auto on loopbus, virtual and vcan*)",
    )
    parser.add_argument(
        "--no-rehearsal", action="store_true", help="do not run each cycle's work before its time too (SCHED_FIFO)"
    )
    parser.add_argument("--cpu", type=int, metavar="N", help="stay on this CPU")
    parser.add_argument(
        "--slow-motion", type=int, default=1, metavar="N",
        help="a second of the loop lasts N: for an emulated machine that cannot keep up, never for a car",
    )  # fmt: skip
    parser.add_argument("--once", action="store_true", help="end after one manoeuvre, or after a fault once it stands")
    parser.add_argument("--status", action="store_true", help="write a JSON line to standard output every 0.2 s")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the flight record")
    parser.add_argument(
        "--listen-only",
        action="store_true",
        help="compute and log everything, send nothing; another controller may drive meanwhile",
    )
    check = parser.add_argument_group("preflight")
    check.add_argument("--preflight", action="store_true", help="go through the checklist before arming, send nothing")
    check.add_argument("--no-hand-wheel", action="store_true", help="leave the check of the steering's sign out")
    check.add_argument("--json", type=Path, metavar="FILE", help="write the checklist for machines too")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the controller, or its preflight.

    Returns the exit status: 0 done, 1 preflight failed, 2 a user's mistake, 3 stopped before the end, 130 interrupted.
    """
    try:
        options = build_parser().parse_args(arguments)
        return _run(options)
    except UserError as error:
        print(f"parkctl: error: {error}", file=sys.stderr)
        return EXIT_MISTAKE
    except KeyboardInterrupt:
        print("parkctl: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def _run(options: argparse.Namespace) -> int:
    table_set = load_tables(options.tables, options.side, options.law, PERIOD_S, options.dbc.resolve().parent)
    codec = load_codec(options.dbc)
    tables = build_tables(table_set, codec)
    if options.out is not None and not options.out.is_dir():
        raise UserError(f"--out {options.out}: no such folder")
    if not 1 <= options.slow_motion <= SLOWEST_MOTION:
        raise UserError(f"--slow-motion {options.slow_motion}: must be from 1 to {SLOWEST_MOTION}")
    if options.preflight and options.slow_motion != 1:
        raise UserError("--slow-motion: a car is not checked in slow motion; leave it out with --preflight")
    bus = _open(options, codec)
    try:
        if bus.is_physical and table_set.law == LAW_PAPER and not options.listen_only:
            raise UserError(f"--law {options.law}: no car can be reversed by it; drive a car with --law car")
        policy = options.realtime or ("required" if bus.is_physical else "auto")
        if options.preflight:
            return preflight.run(
                bus,
                codec,
                table_set,
                # What is not granted is a line of the checklist, not its end.
                set_up("auto" if policy == "required" else policy, options.cpu),
                folder=options.out or Path(),
                hand_wheel=not options.no_hand_wheel,
                json_file=options.json,
            )
        preflight.refuse_unfit_machine(bus, options.out)
        warm_up(codec, tables)
        node = ControllerNode(codec, tables)
        outcome = set_up(policy, options.cpu)
        silent = "; listening only, nothing is sent" if options.listen_only else ""
        print(f"controller on {bus.description}: {outcome.line}{silent}", file=sys.stderr, flush=True)
        rates = RateWatch(codec.messages, PERIOD_US // 1000)
        status_fd = status_writer(options.status)
        clock = Clock(options.slow_motion)
        result = Loop(
            node,
            bus,
            rates,
            realtime=outcome,
            once=options.once,
            status_fd=status_fd,
            clock=clock,
            rehearses=not options.no_rehearsal,
        ).run()
    finally:
        bus.close()
    if options.out is not None:
        node.record.write_csv(options.out / "flight_record.csv")
    return _report(result, status=options.status, once=options.once)


def _open(options: argparse.Namespace, codec: Codec) -> Bus:
    """Open the bus: for preflight with all that is on it, for the loop with the DBC's frames only."""
    ids = [codec.messages[name].frame_id for name in (INPUT_MESSAGES if options.listen_only else codec.messages)]
    return open_bus(
        options.interface,
        options.channel,
        options.bitrate,
        use_config=not options.no_config,
        only_ids=() if options.preflight else ids,
        listen_only=options.listen_only and not options.preflight,
    )


def _report(result: RunResult, *, status: bool, once: bool) -> int:
    """Tell how the run ended; return the exit status."""
    if status:
        os.set_blocking(1, True)
        print(json.dumps({"final": result.final}), flush=True)
    stopped = result.final["mode"] == MODE_FAULT or (once and not result.completed)
    if not stopped:
        return EXIT_DONE
    text = f"parkctl: stopped: {TEXT[result.reason]}"
    if result.final["overruns"]:
        text += f" ({result.final['overruns']} cycles late, {result.final['longest_stall_cycles']} in a row at most)"
    print(text, file=sys.stderr)
    return EXIT_STOPPED


if __name__ == "__main__":
    sys.exit(main())
