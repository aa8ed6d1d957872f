"""A printed optical element for your own programs. A frozen printer model predicts the printed heights from
the trainable levels of the element, and the heights modulate a wave.
"""
