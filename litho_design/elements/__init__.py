"""A printed optical element for your own programs. A frozen model turns its free levels into heights, and the
heights modulate a wave.
"""
