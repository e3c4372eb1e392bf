"""What was seen: sessions of gauge readings, the observation model, synthetic readings."""
