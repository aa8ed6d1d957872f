"""Which of the effects that stand out is taken: contests and confirmation."""
