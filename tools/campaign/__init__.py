"""Monte Carlo over whole manoeuvres: the core and the plant compiled into one function a run."""
