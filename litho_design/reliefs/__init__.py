"""Design reliefs: layouts whose print comes closest to a wanted height map."""
