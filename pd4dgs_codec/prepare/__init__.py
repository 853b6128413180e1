"""From a recording to a folder that can be trained on: frames, camera poses, a report."""
