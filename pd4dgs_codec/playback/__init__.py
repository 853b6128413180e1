"""Pictures of a decoded scene, without torch: networks and planes in compiled kernels, then the rasteriser."""
