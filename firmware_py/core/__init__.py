"""The control law as pure functions on NamedTuples of numbers; `math` is the only import from outside.

Every function here runs unchanged in plain CPython (tables are nested tuples) and under `numba.njit` (tables are
float64 arrays of the same shape) with the same bits in the result. What that forbids: `_replace`, `bisect`,
`math.fmod`, `math.remainder`, `math.hypot`, powers other than products, strings, exceptions, unbounded loops.

Structs that are made in every cycle are made by position, in the order of their fields: by keyword each costs CPython
three to four times as much, and there are two dozen in a cycle.
"""
