"""Makes a folder to train on from a recording: frames, camera poses, a report."""

#: Fewest frames for an estimate of camera poses.
FEWEST_FRAMES = 8
