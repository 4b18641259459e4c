"""`parkctl bench`: all figures in one run, round by round, each beside its floor."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sim.errors import UserError
from tools.bench import opcodes
from tools.bench.rows import LIMITS, Row, quantile, row_of
from tools.run_folder import check_writable_file, write_whole

if TYPE_CHECKING:
    from rich.console import Console

GROUPS = ("wake", "tick", "codec", "turnaround", "process", "lockstep", "campaign")
CONTENT = ("wake.png", "wake_loaded.png", "tick_cold.png", "turnaround.png", "bench.json")
PERIOD_US = 10_000.0


class _Size(NamedTuple):
    """How much is measured."""

    rounds: int
    wake_s: float
    cold_samples: int
    hot_samples: int
    turns: int
    lockstep_s: float
    campaign_runs: int


FULL = _Size(rounds=5, wake_s=3.0, cold_samples=150, hot_samples=1500, turns=150, lockstep_s=60.0, campaign_runs=200)
QUICK = _Size(rounds=2, wake_s=1.5, cold_samples=100, hot_samples=800, turns=80, lockstep_s=20.0, campaign_runs=50)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `parkctl bench`."""
    parser.epilog = (
        "Figures are medians over rounds; what is compared is measured in turns within the same run. The wake-up rows "
        "need cyclictest (Debian's rt-tests) and the right to SCHED_FIFO; the row turnaround_vcan a vcan0 "
        "(parkctl guest -- parkctl bench --only turnaround). What cannot be measured here is in the table with why."
    )
    parser.add_argument("--quick", action="store_true", help="fewer rounds and samples")
    parser.add_argument("--only", metavar="GROUP", choices=GROUPS, action="append", help=" | ".join(GROUPS))
    parser.add_argument("--json", type=Path, metavar="FILE", help="the rows for machines")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the histograms and bench.json")
    parser.add_argument(
        "--update-opcodes", action="store_true", help="measure nothing; count and store the opcodes a tick takes"
    )


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, write what was asked for; return the exit status."""
    from rich.console import Console  # noqa: PLC0415

    console = Console()
    if args.update_opcodes:
        counts = opcodes.count_opcodes()
        opcodes.store(counts)
        console.print(f"{opcodes.STORED}: {opcodes.text_of(counts)}", soft_wrap=True)
        return 0
    if args.json is not None:
        check_writable_file(args.json)
    if args.out is not None:
        _make_folder(args.out)
    bench = Bench(QUICK if args.quick else FULL, tuple(args.only or GROUPS), console)
    bench.measure()
    rows = bench.rows()
    _print(console, rows)
    for note in bench.notes:
        console.print(note, soft_wrap=True, highlight=False)
    text = json.dumps({"quick": args.quick, "notes": bench.notes, "rows": [row.as_dict() for row in rows]}, indent=2)
    if args.json is not None:
        write_whole(args.json, text + "\n")
    if args.out is not None:
        bench.draw(args.out)
        write_whole(args.out / "bench.json", text + "\n")
        console.print(f"histograms and bench.json in {args.out}", soft_wrap=True)
    return 0


def _make_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out {folder}: is a file; name a folder")
    if folder.is_dir() and any(path.name not in CONTENT for path in folder.iterdir()):
        raise UserError(f"--out {folder}: holds files that are not of a bench; name an empty or new folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder}: cannot be made: {error.strerror}") from None
    if not os.access(folder, os.W_OK):
        raise UserError(f"--out {folder}: no right to write there")


class Bench:
    """One run of the bench: rounds of all groups in turn, then the rows."""

    def __init__(self, size: _Size, groups: tuple[str, ...], console: Console) -> None:
        self._size = size
        self._groups = groups
        self._console = console
        self._rounds: dict[str, list[float]] = defaultdict(list)  # one figure a round
        self._samples: dict[str, list[float]] = defaultdict(list)  # all samples in us, for the pictures
        self._why: dict[str, str] = {}
        self.notes: list[str] = []

    def measure(self) -> None:
        """Run all rounds."""
        with contextlib.ExitStack() as stack:
            steps: list[tuple[str, Callable[[], None]]] = []
            if {"tick", "codec"} & set(self._groups):
                self._say("recording a manoeuvre, compiling the floor (half a minute)")
                worker = stack.enter_context(_worker())
                self._note_worker(worker)
                if "tick" in self._groups:
                    steps.append(("tick", lambda: self._tick(worker)))
                if "codec" in self._groups:
                    steps.append(("codec", lambda: self._codec(worker)))
            if "wake" in self._groups and self._wake_is_possible():
                steps.append(("wake-ups", self._wake))
            if "turnaround" in self._groups:
                steps.append(("turnaround", self._turnaround))
            if "process" in self._groups:
                steps.append(("start of the controller", self._process))
            if "lockstep" in self._groups:
                steps.append(("lock-step", self._lockstep))
            if "campaign" in self._groups:
                steps.append(("campaign (compiles the first time: half a minute)", self._campaign))
            for number in range(self._size.rounds):
                for name, step in steps:
                    self._say(f"round {number + 1} of {self._size.rounds}: {name}")
                    step()

    def _say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def _keep(self, name: str, samples: list[float], *shares: float) -> None:
        """Keep samples in us, and for this round the quantiles asked for."""
        self._samples[name] += samples
        for share in shares:
            self._rounds[f"{name}_p{share * 100:.0f}"].append(quantile(samples, share))

    # -- groups -------------------------------------------------------------------------------------------------------

    def _note_worker(self, worker: _Worker) -> None:
        told = worker.told
        if told["differing_cycles"]:
            raise UserError(
                f"the compiled core differs from the plain one in {told['differing_cycles']} of {told['cycles']} cycles"
            )
        self.notes.append(f"compiled and plain tick: the same bits in all {told['cycles']} recorded cycles")
        self.notes.append(f"tick and codec measured with {told['realtime']}")
        self.notes.append(
            "tick_cold: the core's cycle as the loop runs it under SCHED_FIFO: rehearsed on the inputs of the cycle "
            "before, as often as it fits in before its deadline, in place of most of the spin. tick_unrehearsed: "
            "straight after its sleep, as is the compiled floor of both: tick_cold is the loop's way against a "
            "compiled cycle without it"
        )

    def _tick(self, worker: _Worker) -> None:
        cold = worker.do("tick_cold", self._size.cold_samples)
        hot = worker.do("tick_hot", self._size.hot_samples)
        for kind, samples in cold.items():
            self._keep(f"tick_cold {kind}", samples, 0.5, 0.99)
        for kind, samples in hot.items():
            self._keep(f"tick_hot {kind}", samples, 0.5)

    def _codec(self, worker: _Worker) -> None:
        for way, samples in worker.do("codec", self._size.hot_samples).items():
            self._keep(f"codec {way}", samples, 0.5)

    def _wake_is_possible(self) -> bool:
        from tools.bench import wake  # noqa: PLC0415

        why = wake.why_no_cyclictest()
        if why:
            self._why |= dict.fromkeys((name for name in LIMITS if name.startswith("wake_")), why)
        return not why

    def _wake(self) -> None:
        from tools.bench import wake  # noqa: PLC0415

        seconds = self._size.wake_s
        for load in ("", "_loaded"):
            with wake.hogs() if load else contextlib.nullcontext():
                late, no_fifo = wake.loop_late_us("auto", seconds)
                if no_fifo:
                    self._why |= {f"wake_{p}_fifo{load}": no_fifo for p in ("p50", "p99")}
                else:
                    self._keep(f"wake fifo{load}", late, 0.5, 0.99)
                self._keep(f"wake cyclictest{load}", wake.cyclictest_late_us(seconds), 0.5, 0.99)
                if load:
                    self._keep(f"wake normal{load}", wake.loop_late_us("off", seconds)[0], 0.5, 0.99)

    def _turnaround(self) -> None:
        from tools.bench.process import free_channels  # noqa: PLC0415

        channels = ",".join(free_channels(2))
        self._turn("turnaround_loopbus", "loopbus", channels)
        if Path("/sys/class/net/vcan0").exists():
            self._turn("turnaround_vcan", "socketcan", "vcan0")
        else:
            self._why["turnaround_vcan"] = "no vcan0 here; parkctl guest -- parkctl bench --only turnaround"

    def _turn(self, name: str, interface: str, channels: str) -> None:
        command = [sys.executable, "-P", "-m", "tools.bench.turnaround", interface, channels, str(self._size.turns)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
        turns = json.loads(done.stdout) if done.returncode == 0 else {}
        if not turns or not all(turns.values()):
            lines = done.stderr.strip().splitlines()
            self._why[name] = lines[-1] if lines else "no answer on the bus"
            return
        for kind, samples in turns.items():
            self._keep(f"{name} {kind}", [ns * 1e-3 for ns in samples], 0.5)

    def _process(self) -> None:
        from firmware_py.codec import load_codec  # noqa: PLC0415
        from tools.bench.process import start_controller  # noqa: PLC0415
        from tools.lockstep import DBC  # noqa: PLC0415

        started = start_controller(load_codec(DBC).messages["CTRL_SysCmd"].frame_id)
        self._rounds["startup_s"].append(started.startup_s)
        self._rounds["rss_mib"].append(started.rss_mib)

    def _lockstep(self) -> None:
        from tools.bench.process import lockstep_times_real_time  # noqa: PLC0415

        self._rounds["lockstep_ratio"].append(lockstep_times_real_time(self._size.lockstep_s))

    def _campaign(self) -> None:
        from tools.bench.process import campaign_runs_per_s  # noqa: PLC0415

        compiled, plain = campaign_runs_per_s(self._size.campaign_runs)
        self._rounds["campaign_rate"].append(compiled)
        self._rounds["campaign plain"].append(plain)

    # -- results ------------------------------------------------------------------------------------------------------

    def rows(self) -> list[Row]:
        """Return all rows of LIMITS, in its order."""
        figures = {
            "tick_cold_p50": ("tick_cold looped_p50", "tick_cold compiled_p50"),
            "tick_unrehearsed_p50": ("tick_cold plain_p50", "tick_cold compiled_p50"),
            "tick_unrehearsed_p99": ("tick_cold plain_p99", ""),
            "tick_hot": ("tick_hot plain_p50", "tick_hot compiled_p50"),
            "tick_hot_in_calls": ("tick_hot plain_p50", "tick_hot empty_p50"),
            "codec_frame": ("codec own_p50", "codec socket_p50"),
            "codec_frame_by_cantools": ("codec own_p50", "codec cantools_p50"),
            "campaign_rate": ("campaign_rate", "campaign plain"),
            "wake_p99_normal_loaded": ("wake normal_loaded_p99", "wake cyclictest_loaded_p99"),
        }
        for share in ("p50", "p99"):
            for load in ("", "_loaded"):
                figures[f"wake_{share}_fifo{load}"] = (f"wake fifo{load}_{share}", f"wake cyclictest{load}_{share}")
        for name in ("turnaround_loopbus", "turnaround_vcan"):
            figures[name] = (f"{name} controller_p50", f"{name} echo_p50")
        values = dict(self._rounds)
        for name, source in (("tick_cold_p99_of_period", "looped_p99"), ("rehearsal_of_period", "rehearsal_p50")):
            if f"tick_cold {source}" in values:
                values[name] = [100.0 * us / PERIOD_US for us in values[f"tick_cold {source}"]]
        rows = []
        for name in LIMITS:
            value, floor = figures.get(name, (name, ""))
            if values.get(value) and name not in self._why:
                rows.append(row_of(name, values[value], values[floor] if floor else ()))
            else:
                rows.append(Row(name, why=self._why.get(name, "not asked for (--only)")))
        return rows

    def draw(self, folder: Path) -> None:
        """Write the histograms of what was measured."""
        from tools.plots import histogram  # noqa: PLC0415 -- matplotlib

        for stem, title, prefix, loaded in (
            ("wake", "lateness of wake-ups, idle", "wake ", False),
            ("wake_loaded", "lateness of wake-ups, two hogs", "wake ", True),
            ("tick_cold", "one cycle of the core after 10 ms of sleep", "tick_cold ", None),
            ("turnaround", "first report sent to steering frame received", "turnaround_", None),
        ):
            chosen = {
                name.removeprefix(prefix): samples
                for name, samples in self._samples.items()
                if name.startswith(prefix) and loaded in (None, name.endswith("_loaded"))
            }
            if chosen:
                histogram(folder / f"{stem}.png", title, chosen)


class _Worker:
    """The process that measures tick and codec."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.told: dict[str, Any] = self._answer()

    def do(self, what: str, samples: int) -> dict[str, list[float]]:
        """Return samples in us by name."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": what, "samples": samples}) + "\n")
        self._process.stdin.flush()
        return {name: [ns * 1e-3 for ns in values] for name, values in self._answer().items()}

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise UserError("the process that measures tick and codec has failed; its complaint stands above")
        return json.loads(line)


@contextlib.contextmanager
def _worker() -> Iterator[_Worker]:
    command = [sys.executable, "-P", "-m", "tools.bench.worker"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield _Worker(process)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.terminate()


def _print(console: Console, rows: list[Row]) -> None:
    """Print the table, and below it what each floor is and why a row is empty: it fits 80 columns."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="parkctl bench: medians over rounds", title_justify="left")
    for heading in ("figure", "value", "floor", "ratio", "must", "aim", ""):
        table.add_column(heading, justify="left" if heading in ("figure", "") else "right", no_wrap=True)
    for row in rows:
        limit = LIMITS[row.name]
        sign = "≥ " if limit.at_least else "≤ "
        value = "" if row.value is None else f"{_number(row.value)} {limit.unit}"
        bounds = ["" if bound is None else f"{sign}{bound:g}" for bound in (limit.must, limit.aim)]
        mark = {"aim": "[green]aim[/]", "must": "[green]ok[/]", "over": "[red]OVER[/]"}.get(row.verdict, "")
        table.add_row(row.name, value, _number(row.floor), _number(row.ratio), *bounds, mark)
    console.print(table)
    against: dict[str, list[str]] = {}
    for row in rows:
        if row.floor is not None:
            against.setdefault(f"floor: {LIMITS[row.name].against}", []).append(row.name)
        elif row.why:
            against.setdefault(f"not measured: {row.why}", []).append(row.name)
    for text, names in against.items():
        console.print(f"{', '.join(names)}: {text}", highlight=False, markup=False)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
