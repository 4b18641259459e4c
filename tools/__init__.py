"""Offline tools around the controller and the plant; `parkctl` is their command line."""
