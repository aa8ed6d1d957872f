"""A printed optical element for your own programs. The element has trainable levels. A frozen printer model
predicts the printed heights of these levels, and the heights modulate a wave.
"""
