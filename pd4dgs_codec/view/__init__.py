"""What a file looks like: its levels ready to draw, the frames to take, panels and films of them, and their quality.

levels: a model per level. frames: cameras and times. panels: levels side by side. movie: pictures to files. evaluate:
metrics per level on a dataset's views.
"""
