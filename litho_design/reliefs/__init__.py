"""Design reliefs: layouts whose print comes closest to a target height map."""
