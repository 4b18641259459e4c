"""`parkctl guest -- COMMAND`: run a command where a real vcan0 exists."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import UserError
from tools.guest import hardware, image, session

if TYPE_CHECKING:
    import argparse

DEFAULT_RESULTS = "runs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `parkctl guest`."""
    parser.usage = "parkctl guest [--hardware] [--install] [--results DIR]... [--] COMMAND [ARGUMENT]..."
    parser.epilog = (
        "The guest is Debian's user-mode-linux: an ordinary process, no root needed. It sees this machine's files, "
        "read-only but for the folders of --results; there is no network, one CPU, and vcan0 is up. On a terminal the "
        "command gets one too (parkctl guest -- bash); else its input is empty. "
        "Exit status: that of COMMAND; 2 where the guest cannot start."
    )
    parser.add_argument(
        "--install", action="store_true", help=f"fetch what is needed into {image.image_folder()}, with apt-get"
    )
    parser.add_argument(
        "--hardware",
        action="store_true",
        help="in place of vcan0 an emulated machine (QEMU) with two CAN cards, can0 and can1, on one bus: the real "
        "driver, but some fifty times slower; needs qemu-system-x86, and --install fetches its kernel",
    )
    parser.add_argument(
        "--results",
        action="append",
        metavar="DIR",
        help=f"folder that COMMAND may write to; made if it is not there (default: {DEFAULT_RESULTS})",
    )
    parser.add_argument("--verbose", action="store_true", help="say on stderr how long the guest took to start")
    parser.add_argument("command", nargs="*", metavar="COMMAND", help="what to run, as in: -- candump vcan0")


def run(args: argparse.Namespace) -> int:
    """Run the command in the guest; return its exit status. Raises UserError where that cannot be."""
    if args.install:
        print(f"guest installed in {hardware.install() if args.hardware else image.install()}")
        if not args.command:
            return 0
    if not args.command:
        raise UserError("guest: name the command to run, as in: parkctl guest -- candump vcan0")
    if "PARKCTL_IN_GUEST" in os.environ:
        raise UserError("guest: this is the guest already; run the command by itself")
    reason = hardware.why_not() if args.hardware else image.why_not()
    if reason is not None:
        raise UserError(reason)
    writable = [_made_folder(Path(name)) for name in args.results or [DEFAULT_RESULTS]]
    if args.hardware:
        outcome = hardware.run_in_machine(args.command, writable)
    else:
        outcome = session.run_in_guest(image.find_image(), args.command, writable)
    if args.verbose:
        print(f"guest started in {outcome.boot_s:.1f} s", file=sys.stderr)
    return outcome.status


def _made_folder(path: Path) -> Path:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--results {path}: cannot be made a folder: {error.strerror}") from None
    if not os.access(path, os.W_OK):
        raise UserError(f"--results {path}: no right to write there")
    return path.resolve()
