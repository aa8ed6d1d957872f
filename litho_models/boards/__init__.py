"""Boards: stores of the virtual fab whose causes are hidden, and the judge of what a loop says of them."""
