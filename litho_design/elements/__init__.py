"""The printer as an optical element for your own programs. The element takes free levels and returns a
modulated wave.
"""
