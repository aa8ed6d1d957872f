"""What a scan adds to the height, and how it is taken out on pixels that are not scored."""
