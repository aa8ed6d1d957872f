"""The loop, built anew."""
