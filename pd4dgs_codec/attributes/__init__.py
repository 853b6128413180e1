"""float32 <-> int32 symbols: the quantiser, the table of anchor attributes, plane decorrelation. No torch."""
