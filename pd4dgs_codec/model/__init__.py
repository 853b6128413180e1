"""The torch model: scaffold, HexPlanes, deformations, masks, rate; checkpoints; pictures of a model."""
