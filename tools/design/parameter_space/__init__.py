"""Robust design in parameter space: the gains that keep all poles of a loop in a region, with every boundary named.

For any plant with one input and one output that python-control can hold, continuous (with a dead time, exactly) or
sampled, in a PID loop with negative feedback, C(s) = kp + ki/s + kd s/(lag s + 1):

    import control
    from tools.design.parameter_space import DRegion, Window, admissible_region, case_of, plane_of

    plane = plane_of("kp-ki", third=0.5)                 # kp over x, ki over y, kd = 0.5
    region = DRegion(sigma_radps=0.5, zeta=0.6)          # d1 shift, d2 wedge, d3 radius (radius_radps=...)
    case = case_of("oven", control.tf([1], [1, 2, 1]), plane, region, delay_s=0.2)
    found = admissible_region([case], plane)             # or with Window(x_low, x_high, y_low, y_high)
    found.inside, found.x, found.y                       # (ny, nx) booleans over the grid
    found.outline                                        # polylines (n, 2)
    found.boundaries                                     # Boundary(kind "CRB|RRB|IRB", piece "d1|d2|d3", x, y, s, ...)
    found.absent                                         # {"IRB": "why it does not exist", ...}
    point = found.choose("centre")                       # or "smallest", "smallest on CRB d1", or found.point(x, y)
    point.gains, point.distances                         # {"CRB d1": Distance(distance, x, y, case), ...}
    found.poles(point.x, point.y)                        # {case: poles}

Over a speed grid and the corners of a box: `cases_over(plant_at, speeds, plane, region_at, box={"mass": (low, high)})`
makes one case each, and `admissible_region` takes their intersection. Other loops that are affine in two parameters:
`Case(name, Characteristic(free, late, of_x, of_y, delay_s), region)`.

Distances are in scaled coordinates: over the sides of the window. Whether a point is admissible is judged by the poles
(companion-matrix eigenvalues; with a delay counted by the argument principle), never by the boundaries. A mistake in
what is given, and an empty set, raise sim.errors.UserError with one line that says why.

Source: the paper's equation 19 and Figures 11 to 13; Ackermann, "Robust Control: The Parameter Space Approach", ch. 3
and 4 for complex-, real- and infinite-root boundaries and singular frequencies.
"""

from tools.design.parameter_space.admissible import (
    RULES,
    AdmissibleRegion,
    Case,
    Distance,
    Point,
    admissible_region,
    case_of,
    cases_over,
    find_window,
)
from tools.design.parameter_space.boundaries import Boundary, Window, boundaries
from tools.design.parameter_space.d_region import DRegion, Piece
from tools.design.parameter_space.loop import Characteristic, Pid, Plane, Plant, characteristic, plane_of, plant_of
from tools.design.parameter_space.roots import closed_loop_poles, poles_outside

__all__ = [
    "RULES",
    "AdmissibleRegion",
    "Boundary",
    "Case",
    "Characteristic",
    "DRegion",
    "Distance",
    "Pid",
    "Piece",
    "Plane",
    "Plant",
    "Point",
    "Window",
    "admissible_region",
    "boundaries",
    "case_of",
    "cases_over",
    "characteristic",
    "closed_loop_poles",
    "find_window",
    "plane_of",
    "plant_of",
    "poles_outside",
]
