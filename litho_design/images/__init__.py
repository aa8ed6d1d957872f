"""Target images, photographs, and measures of similarity."""
