"""What only the pages under docs/ need: the main job on whole scenes, the paper's tables."""
