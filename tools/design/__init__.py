"""From vehicle and course files to the tables that the firmware runs on."""
