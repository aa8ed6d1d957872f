"""Frozen models. A frozen model is a folder with the weights of a trained process model and a model card
(``card.json``). This package writes, loads and exports frozen models, and contains a zoo of ready-made ones.
"""
