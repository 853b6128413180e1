"""Error against run time: the codec, the rasteriser and the trainer, each swept over what trades one for the other."""
