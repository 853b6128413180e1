"""Makes a folder to train on from a recording: frames, camera poses, a report."""
