"""`parkctl deploy`: what goes into the car."""

from __future__ import annotations

import argparse
from pathlib import Path

from tools.deploy.wheel import build_wheel


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the job and its options."""
    jobs = parser.add_subparsers(metavar="JOB", required=True, dest="job")
    wheel = jobs.add_parser(
        "wheel",
        help="build the wheel of the controller alone",
        description="Build the wheel of the controller alone: pip install it in the car, then python -m firmware_py. "
        "systemd units and an example of their options land in PREFIX/share/parkctl, parkctl-can-up in PREFIX/bin.",
    )
    wheel.add_argument("--out", type=Path, default=Path("dist"), metavar="DIR", help="folder of the wheel (dist)")


def run(args: argparse.Namespace) -> int:
    """Build the wheel; returns 0."""
    file = build_wheel(args.out)
    print(f"{file} ({file.stat().st_size / 1024:.0f} KiB)")
    return 0
