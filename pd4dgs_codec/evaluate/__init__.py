"""A decoded scene's networks and planes, evaluated and enclosed in numpy, without torch."""
