"""The controller as it sits in the car: CAN frames in, CAN frames out, every 10 ms."""
