"""Find where every array comes from: history, verification, replay."""
