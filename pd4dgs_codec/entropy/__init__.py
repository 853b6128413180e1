"""int32 symbols <-> payload bytes: integer frequency tables, priors, the ANS stream, and an LZMA mode."""
