"""Episode files to and from the formats of LeRobot, RoboManipBaselines and ALOHA."""
