"""Frozen models: trained process models in folders with weights and a card. This package writes, loads and
exports them, and contains the zoo of ready-made ones.
"""
