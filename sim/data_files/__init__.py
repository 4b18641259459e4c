"""Vehicle, course and scenario files: load, check, and say in one line what is wrong.

All three are TOML. Every key is checked: unknown, missing, of the wrong type or unit, or out of range ends in a
`UserError` that names file and key. CONVENTIONS.md in dbc/ explains frames, signs and hashes.
"""

from sim.data_files.course import (
    SIDES,
    Cone,
    Course,
    MistakeRule,
    Pose,
    ScoredMistake,
    ScoreSheet,
    Side,
    StartAtBumper,
    StartAtPoint,
    StopAtBumper,
    StopByDisplacement,
    Tolerances,
    check_fit,
    load_course,
)
from sim.data_files.reading import FOLDERS, ROOT, find_file, shipped_names
from sim.data_files.scenario import Draw, PlantDeviation, Scenario, Sensors, StartOffset, load_scenario, true_vehicle
from sim.data_files.vehicle import PARAMETERS, Criteria, Parameter, Vehicle, check_parameters, load_vehicle

__all__ = [
    "FOLDERS",
    "PARAMETERS",
    "ROOT",
    "SIDES",
    "Cone",
    "Course",
    "Criteria",
    "Draw",
    "MistakeRule",
    "Parameter",
    "PlantDeviation",
    "Pose",
    "Scenario",
    "ScoreSheet",
    "ScoredMistake",
    "Sensors",
    "Side",
    "StartAtBumper",
    "StartAtPoint",
    "StartOffset",
    "StopAtBumper",
    "StopByDisplacement",
    "Tolerances",
    "Vehicle",
    "check_fit",
    "check_parameters",
    "find_file",
    "load_course",
    "load_scenario",
    "load_vehicle",
    "shipped_names",
    "true_vehicle",
]
