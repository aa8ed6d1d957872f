"""Designs and scores for people."""
