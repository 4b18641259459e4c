"""`parkctl`: one program, a subcommand a job; a subcommand's module is loaded only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from typing import NoReturn

from firmware_py import errors as firmware_errors
from sim import errors as sim_errors

# The design's matrices are small: further BLAS threads would only wait for each other. Before anything loads numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

COMMANDS = {
    "demo": ("tools.demo", "the whole test: car and controller as processes of their own, judged by the examiner"),
    "operate": ("tools.operator_station", "the operator station alone: start, stop, emergency stop, clear by keys"),
    "design": ("tools.design_cmd", "make or check the controller's tables from vehicle and course files"),
    "parameter-space": (
        "tools.design.parameter_space.command",
        "the PID gains that keep all poles of a plant of your own in a region, with boundaries and page",
    ),
    "paper": ("tools.paper.command", "the paper's tables and figures, ours beside the printed ones, on one page"),
    "deploy": (
        "tools.deploy.command",
        "what goes into the car: the wheel of the controller alone, with its systemd units",
    ),
    "campaign": (
        "tools.campaign.command",
        "Monte Carlo: thousands of tests with car, sensors and start not known before",
    ),
    "compare": (
        "tools.compare.command",
        "ten other controllers beside the shipped one, tuned alike, on the same plant, path and seeds",
    ),
    "bench": ("tools.bench.command", "what the controller costs: jitter, tick, codec, turnaround, beside their floors"),
    "soak": ("tools.bench.soak", "many tests in a row with the same processes: frames, faults, memory, late cycles"),
    "guest": ("tools.guest.command", "run a command where a real vcan0 is, on any Linux on x86-64, without root"),
}
"""Subcommand: (module with add_arguments(parser) and run(args) -> exit status, what it is for)."""

PROCESSES = {
    "drive": ("firmware_py", "the controller alone, on any bus; a vehicle and an operator station must be there too"),
    "preflight": ("firmware_py", "the checklist before the car may be armed: bus, reports, signs, privileges, disk"),
    "emulate": ("sim", "the car alone: the plant emulator, on a bus in place of a vehicle"),
}
"""Subcommand: (package that takes this process's place and has its own options, what it is for)."""

ORDER = (
    "demo",
    "drive",
    "emulate",
    "operate",
    "preflight",
    "design",
    "parameter-space",
    "paper",
    "compare",
    "campaign",
    "deploy",
    "bench",
    "soak",
    "guest",
)

STATUS_FAILED = 1
STATUS_USER_ERROR = 2
STATUS_INTERRUPTED = 130

EPILOG = """\
first steps:
  parkctl demo                                      the standard car, Ohio course, left side (about 40 s)
  parkctl demo --lockstep --seed 7                  the same in virtual time: seconds, and repeatable
  parkctl demo --vehicle my_car.toml --side right   a car of your own
by hand, in three terminals:
  parkctl emulate     parkctl drive     parkctl operate
each subcommand explains itself:
  parkctl demo --help
"""


class _Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise sim_errors.UserError(f"{message} (see {self.prog} --help)")


def main(arguments: list[str] | None = None) -> int:
    """Run `parkctl`; return the exit status: 0 job done, 1 not done, 2 a mistake in what was given, 130 interrupted."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        if given and given[0] in PROCESSES:
            return _become_process(given[0], given[1:])
        return _run(given)
    except (firmware_errors.UserError, sim_errors.UserError) as error:
        print(f"parkctl: error: {error}", file=sys.stderr)
        return STATUS_USER_ERROR
    except BrokenPipeError:  # the reader of a pipe has gone, as in `parkctl ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return STATUS_FAILED
    except KeyboardInterrupt:
        print("parkctl: interrupted", file=sys.stderr)
        return STATUS_INTERRUPTED


def _run(given: list[str]) -> int:
    purposes = {name: purpose for name, (_, purpose) in (COMMANDS | PROCESSES).items()}
    parser = _Parser(
        prog="parkctl",
        description="A drive-by-wire car takes the Ohio manoeuvrability test by itself.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(metavar="COMMAND", title="commands", required=True)
    for name in ORDER:
        text = purposes[name]
        command = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        if given and given[0] == name and name in COMMANDS:
            module = importlib.import_module(COMMANDS[name][0])
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    args = parser.parse_args(given)
    return int(args.run(args))


def _become_process(name: str, arguments: list[str]) -> int:
    """Put the controller's or the plant's process in the place of this one; returns only if that fails."""
    environment = dict(os.environ)
    if name == "preflight":
        arguments = ["--preflight", *arguments]
    if name == "emulate":
        arguments, environment = _own_bus(arguments)
    # -P: a folder of the user's own called `sim` must not take the module's place.
    os.execve(sys.executable, [sys.executable, "-P", "-m", PROCESSES[name][0], *arguments], environment)


def _own_bus(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """Return the emulator's arguments and environment with its bus settled; settings for real cars do not count."""
    from tools.buses import choose_own_bus, environment_without_can_settings  # noqa: PLC0415

    parser = _Parser(prog="parkctl emulate", add_help=False)
    parser.add_argument("-i", "--interface")
    parser.add_argument("-c", "--channel")
    parser.add_argument("-b", "--bitrate", type=int)
    named, rest = parser.parse_known_args(arguments)
    bus = choose_own_bus(named.interface, named.channel, named.bitrate)
    return [*bus.arguments(), *rest], environment_without_can_settings()


if __name__ == "__main__":
    sys.exit(main())
