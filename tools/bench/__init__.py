"""`parkctl bench`: what the controller costs, each figure beside its floor, measured in one run."""
