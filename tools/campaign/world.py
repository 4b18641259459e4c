"""Makes what a run without a bus starts from: the world of `tick`, the records as arrays, and a plant to call."""

import functools
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from sim import drive_by_wire as dbw
from sim import plant
from sim.body import outline_of
from sim.can_side import message_timeouts_ns
from sim.data_files import Course, Scenario, Side, Vehicle, load_course, load_scenario, load_vehicle
from sim.drive_by_wire import TIMED
from sim.examiner import Yardstick
from sim.plant import Memory, Motion, TruthRow
from sim.sensors import NORMALS, NoiseRows, SensorState, first_state
from tools.campaign import tick, wire
from tools.campaign.tick import Command, Reports, World
from tools.compiled import PLANT_MODULES, cache_folder, cached_njit, compile_modules, source_to_functions
from tools.flat import Namespace, flat, rebuilder, written

DBC = Path(__file__).resolve().parent.parent.parent / "dbc" / "parking.dbc"
TICK_MODULES = (*PLANT_MODULES, "tools.campaign.wire", "tools.campaign.tick")
REPORT_NUMBERS = 40
"""Numbers in a Reports."""


class Beginning(NamedTuple):
    """A run before its first tick; `memory` is still lists."""

    world: World
    motion: Motion
    memory: Memory
    start: tuple[float, float, float]


def begin(
    vehicle: Vehicle,
    course: Course,
    scenario: Scenario,
    side: Side,
    seed: int,
    scales: wire.Scales | None = None,
    timeouts_ns: tuple[int, int, int, int] | None = None,
) -> Beginning:
    """Draw car, sensors and start as the emulator does; the time begins at 0.

    What is not given (scales, and timeouts of the messages in `drive_by_wire.TIMED`) is read from the shipped DBC.

    Raises UserError where the car does not fit the course.
    """
    scales = wire.load_scales(DBC) if scales is None else scales
    if timeouts_ns is None:
        sys_ns, steer_ns, long_ns, version_ns = message_timeouts_ns(DBC, TIMED)
        timeouts_ns = (sys_ns, steer_ns, long_ns, version_ns)
    setup = plant.set_up(vehicle, course, scenario, side, seed, timeouts_ns)
    nominal = vehicle.with_overlay(scenario.vehicle_overlay)
    world = World(
        car=setup.car,
        sensors=setup.sensors,
        scales=scales,
        yardstick=Yardstick(outline_of(nominal), course.cones_xy(side), course.cone_radius_m),
        start_ns=0,
        pose_latency_ms=wire.report(1.0e-6 * plant.PERIOD_NS * nominal.pose_latency_samples, scales.pose_latency_ms),
        position_sigma_m=wire.report(scenario.sensors.stated_position_sigma_m, scales.position_sigma_m),
    )
    memory = plant.begin_memory(0)
    motion = plant.begin(setup.car, memory, setup.start, 0)
    return Beginning(world, motion, memory, setup.start)


def arm(memory: Memory) -> None:
    """Put the drive-by-wire system where a loop without a handshake needs it: Active, park brake off, in Drive."""
    system = memory.system
    system[dbw.STATE], system[dbw.REASON] = dbw.ACTIVE, dbw.NO_REASON
    system[dbw.FIRST_ACTIVE_NS] = 0
    system[dbw.PARK_BRAKE_APPLIED] = 0
    system[dbw.GEAR] = system[dbw.GEAR_WANTED] = dbw.DRIVE
    system[dbw.ENABLE] = 1
    system[dbw.NEXT_EVENT_NS] = 0  # the watchdog looks at once when it is next due
    system[dbw.VERSION_REASON] = dbw.NO_REASON
    for message in range(len(TIMED)):
        system[dbw.LAST_VALID_NS + message] = 0


def as_arrays(memory: Memory) -> Memory:
    """Return the records as arrays, int64 and float64, as compiled functions need them."""
    kinds = {int: np.int64, float: np.float64}
    return Memory(*[np.array(record, dtype=kinds[type(record[0])]) for record in memory])  # type: ignore[arg-type]


def array_world(world: World) -> World:
    """Return the world with the cones as an array, so that their number is no matter of types."""
    cones: Any = np.array(world.yardstick.cones, dtype=np.float64)
    return world._replace(yardstick=world.yardstick._replace(cones=cones))


def compiled_tick() -> ModuleType:
    """Return `tick` compiled: `sense` and `obey`, for compiled functions to call."""
    return compile_modules(*TICK_MODULES)["tools.campaign.tick"]


class PlantEntries(NamedTuple):
    """`sense` and `obey` on arrays, compiled once a process; the numbers of what `sense` gives back as nests.

    sense(world, cones, state, system, number, value, now_ns, since_ns, normals, out): world and state are rows, the
    state (motion, sensors) is replaced, out is filled with reports and truth. obey(world, cones, state, system,
    number, value, now_ns, command): the same, with a row of the command.
    """

    sense: Any
    obey: Any
    reports_of: Callable[[list[float]], Reports]
    truth_of: Callable[[list[float]], TruthRow]


@functools.cache
def plant_entries() -> PlantEntries:
    """Compile the tick: 20 s, or less than one where it was compiled before."""
    beginning = begin(load_vehicle("paper"), load_course("ohio"), load_scenario("ideal"), "left", 0)
    world = array_world(beginning.world)
    state = (beginning.motion, SensorState(0.0, 0.0, 0.0, 0.0))
    _, _, reports, truth = tick.sense(beginning.world, *state, beginning.memory, 0, plant.PERIOD_NS, [0.0] * NORMALS)
    command = Command(0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0)
    space = Namespace()
    records = "system, number, value"
    lines = [
        f"def sense_entry(world, cones, state, {records}, now_ns, since_ns, normals, out):",
        f"    motion, sensors = {space.built(state, 'state')}",
        f"    motion, sensors, reports, truth = sense({space.built(world, 'world', ('cones',))}, motion, sensors,",
        f"        Memory({records}), now_ns, since_ns, normals)",
        *written(state[0], "motion", "state"),
        *written(state[1], "sensors", "state", len(flat(state[0]))),
        *written(reports, "reports", "out"),
        *written(truth, "truth", "out", len(flat(reports))),
        f"def obey_entry(world, cones, state, {records}, now_ns, command):",
        f"    motion, sensors = {space.built(state, 'state')}",
        f"    motion = obey({space.built(world, 'world', ('cones',))}, motion, Memory({records}), now_ns,",
        f"        {space.built(command, 'command')})",
        *written(state[0], "motion", "state"),
    ]
    compiled = compiled_tick()
    namespace = {**space.names, "Memory": Memory, "sense": compiled.sense, "obey": compiled.obey}
    source = "\n".join(lines) + "\n"
    folder = cache_folder(TICK_MODULES, source)
    source_to_functions(source, namespace, folder, "plant_on_arrays.py")
    return PlantEntries(
        cached_njit(namespace["sense_entry"], folder),
        cached_njit(namespace["obey_entry"], folder),
        rebuilder(reports),
        rebuilder(truth),
    )


class CompiledPlant:
    """Plant and sensors of one run, compiled, for a loop that is closed in Python: `sense`, decide, `obey`, again.

    The car is armed (Active, in Drive); a change of gear takes its time as ever. Reports are sampled 3 ms before the
    controller's cycle and commands arrive 0.5 ms after it, as in lock-step. `truth` is the row of the last `sense`.
    """

    PHASE_NS = 3_000_000
    COMPUTE_NS = 500_000

    def __init__(
        self,
        vehicle: Vehicle,
        course: Course,
        scenario: Scenario,
        side: Side,
        seed: int,
        *,
        scales: wire.Scales | None = None,
    ) -> None:
        beginning = begin(vehicle, course, scenario, side, seed, scales=scales)
        arm(beginning.memory)
        self._entries = plant_entries()
        self._noise = NoiseRows(seed)
        self._normals: Any = self._noise.array(4096)
        self._row = 1
        first = first_state(self._normals[0].tolist())
        world = array_world(beginning.world)
        self._world = (np.array(flat(world), dtype=np.float64), world.yardstick.cones)
        self._state = np.array(flat((beginning.motion, first)), dtype=np.float64)
        self._records = tuple(as_arrays(beginning.memory))
        self._out = np.zeros(REPORT_NUMBERS + len(TruthRow._fields))
        self._command = np.zeros(len(Command._fields))
        self._since_ns = plant.PERIOD_NS - self.PHASE_NS + plant.PERIOD_NS
        self.now_ns = 0
        """Instant of the controller's present cycle."""

    def sense(self) -> Reports:
        """Go on to the next cycle and return its reports."""
        self.now_ns += plant.PERIOD_NS
        if self._row == len(self._normals):
            self._normals = self._noise.array(4096)
            self._row = 0
        sample_ns = self.now_ns - self.PHASE_NS
        normals = self._normals[self._row]
        self._entries.sense(*self._world, self._state, *self._records, sample_ns, self._since_ns, normals, self._out)
        self._since_ns = plant.PERIOD_NS
        self._row += 1
        return self._entries.reports_of(self._out[:REPORT_NUMBERS].tolist())

    @property
    def truth(self) -> TruthRow:
        """The plant itself at the last `sense`."""
        return self._entries.truth_of(self._out[REPORT_NUMBERS:].tolist())

    def obey(self, command: Command) -> None:
        """Let the commands of this cycle arrive."""
        self._command[:] = command
        self._entries.obey(*self._world, self._state, *self._records, self.now_ns + self.COMPUTE_NS, self._command)
