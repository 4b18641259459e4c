"""What goes into the car: the controller's wheel, systemd units, the script that brings the CAN interface up."""
