"""Where every array comes from: history, verification, replay."""
