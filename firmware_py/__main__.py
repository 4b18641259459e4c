"""Composition root of the controller process: options, tables, bus, real time, loop. No logic of its own."""

import argparse
import json
import os
import sys
from pathlib import Path

from firmware_py.bus import open_bus
from firmware_py.codec import load_codec
from firmware_py.core.controller import PERIOD_S
from firmware_py.core.signals import MODE_FAULT
from firmware_py.errors import UserError
from firmware_py.loop import Loop, RunResult, status_writer
from firmware_py.node import ControllerNode, build_tables
from firmware_py.realtime import set_up
from firmware_py.reasons import TEXT
from firmware_py.table_file import LAWS, SIDES, load_tables

HERE = Path(__file__).resolve().parent
DEFAULT_TABLES = HERE / "tables" / "paper-ohio"
DEFAULT_DBC = HERE.parent / "dbc" / "parking.dbc"

EXIT_DONE = 0
EXIT_MISTAKE = 2
EXIT_STOPPED = 3


def build_parser() -> argparse.ArgumentParser:
    """Return the options of the controller process."""
    parser = argparse.ArgumentParser(
        prog="python -m firmware_py",
        description="The parking controller: reads and writes CAN frames every 10 ms until the manoeuvre is over.",
    )
    bus = parser.add_argument_group("bus (python-can's options; CAN_* variables and can.conf are obeyed)")
    bus.add_argument("-i", "--interface", help="python-can interface: loopbus (default), socketcan, kvaser, ...")
    bus.add_argument("-c", "--channel", help="channel of the interface: base port for loopbus, vcan0, can0, ...")
    bus.add_argument("-b", "--bitrate", type=int, help="bit rate in bit/s where the interface sets it")
    bus.add_argument("--no-config", action="store_true", help="ignore CAN_* variables and can.conf")
    parser.add_argument("--tables", type=Path, default=DEFAULT_TABLES, metavar="DIR", help="folder of the tables")
    parser.add_argument("--dbc", type=Path, default=DEFAULT_DBC, metavar="FILE", help="the DBC file")
    parser.add_argument("--side", choices=sorted(SIDES), default="left", help="side on which to pass the point cone")
    parser.add_argument("--law", choices=sorted(LAWS), default="car", help="control law")
    parser.add_argument("--realtime", choices=("auto", "off", "required"), default="auto", help="use of SCHED_FIFO")
    parser.add_argument("--once", action="store_true", help="end after one manoeuvre, or after a fault once it stands")
    parser.add_argument("--status", action="store_true", help="write a JSON line to standard output every 0.2 s")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the flight record")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the controller; return the exit status: 0 done, 2 a user's mistake, 3 stopped before the end."""
    try:
        options = build_parser().parse_args(arguments)
        return _run(options)
    except UserError as error:
        print(f"parkctl: error: {error}", file=sys.stderr)
        return EXIT_MISTAKE


def _run(options: argparse.Namespace) -> int:
    table_set = load_tables(options.tables, options.side, options.law, PERIOD_S, options.dbc.resolve().parent)
    codec = load_codec(options.dbc)
    node = ControllerNode(codec, build_tables(table_set, codec))
    if options.out is not None and not options.out.is_dir():
        raise UserError(f"--out {options.out}: no such folder")
    bus = open_bus(options.interface, options.channel, options.bitrate, use_config=not options.no_config)
    try:
        outcome = set_up(options.realtime)
        print(f"controller on {bus.description}: {outcome.line}", file=sys.stderr, flush=True)
        loop = Loop(node, bus, fifo=outcome.fifo, once=options.once, status_fd=status_writer(options.status))
        result = loop.run()
    finally:
        bus.close()
    if options.out is not None:
        node.record.write_csv(options.out / "flight_record.csv")
    return _report(result, status=options.status, once=options.once)


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
