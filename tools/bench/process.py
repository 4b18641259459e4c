"""Start-up time and memory of the controller's process, as one who waits on the bus sees it."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from sim.errors import UserError
from tools.buses import environment_without_can_settings, open_bus, opened
from tools.processes import Child

LONGEST_S = 30.0
SETTLED_S = 0.5
PORTS = 8
"""Ports of one embedded bus."""


class Started(NamedTuple):
    """Time from exec to the first CTRL_SysCmd on the bus, and resident memory a little later."""

    startup_s: float
    rss_mib: float


def free_channels(count: int, first: int = 29700) -> list[str]:
    """Return base ports of embedded buses that nobody uses."""
    found: list[str] = []
    for base in range(first, first + 100 * PORTS, PORTS):
        if all(_is_free(port) for port in range(base, base + PORTS)):
            found.append(str(base))
            if len(found) == count:
                return found
    raise UserError(f"no {count} x {PORTS} free UDP ports from {first} on")


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def start_controller(sys_cmd_id: int) -> Started:
    """Start the controller on a bus of its own, wait until it speaks, weigh it, and end it."""
    channel = free_channels(1)[0]
    with opened(open_bus("loopbus", channel, None, ignore_settings=True)) as bus:
        begun = time.perf_counter()
        child = Child("controller", "firmware_py", ["-i", "loopbus", "-c", channel, "--no-config"])
        try:
            while True:
                message = bus.recv(LONGEST_S)
                if message is None:
                    child.terminate()
                    raise UserError(f"the controller sent nothing for {LONGEST_S:.0f} s; {child.how_it_ended()}")
                if message.arbitration_id == sys_cmd_id:
                    break
            startup_s = time.perf_counter() - begun
            time.sleep(SETTLED_S)
            return Started(startup_s, rss_mib(child.process.pid))
        finally:
            child.close()


def rss_mib(pid: int) -> float:
    """Return the resident memory of a process. Raises UserError where it has none: it has ended."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024.0
    raise UserError(f"process {pid} has no resident memory; it has ended")


def lockstep_times_real_time(longest_s: float) -> float:
    """Return how much faster than real time the lock-step run is, by the CPU time of a process of its own."""
    program = (
        "import time; from tools.bench.recording import record_run; a = time.process_time(); "
        f"n = record_run({longest_s}).controller['cycles']; print(0.01 * n / (time.process_time() - a))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=environment_without_can_settings(),
    )
    if done.returncode != 0:
        raise UserError(f"the lock-step run failed: {done.stderr.strip().splitlines()[-1]}")
    return float(done.stdout)


_CAMPAIGN = """
import sys, time
from sim.data_files import load_course, load_scenario, load_vehicle
from tools.bench.recording import TABLES
from tools.campaign.draws import draw
from tools.campaign.single import Runner, share

vehicle, scenario = load_vehicle("paper"), load_scenario("car")
shared = share(vehicle, load_course("ohio"), "car", TABLES)
drawn = [draw(vehicle, scenario, seed) for seed in range(int(sys.argv[1]))]


def runs_per_s(runner, drawn):
    begun = time.process_time()
    for one in drawn:
        runner.run(one.scenario, one.side, one.seed)
    return len(drawn) / (time.process_time() - begun)


compiled = Runner(shared)
runs_per_s(compiled, drawn[:1])
print(runs_per_s(compiled, drawn), runs_per_s(Runner(shared, compiled=False), drawn[:1]))
"""


def campaign_runs_per_s(runs: int) -> tuple[float, float]:
    """Return runs a second of one core, by CPU time of a process of its own: compiled, and the same source plain.

    The first time the process compiles, which takes half a minute; it finds that done afterwards.
    """
    done = subprocess.run(
        [sys.executable, "-P", "-c", _CAMPAIGN, str(runs)],
        capture_output=True,
        text=True,
        check=False,
        env=environment_without_can_settings(),
    )
    if done.returncode != 0:
        raise UserError(f"the campaign's runs failed: {done.stderr.strip().splitlines()[-1]}")
    compiled, plain = map(float, done.stdout.split())
    return compiled, plain
