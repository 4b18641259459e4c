"""The other controllers on the same plant in the same loop, and the procedure that tunes them all alike."""
