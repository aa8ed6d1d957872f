"""Draw and read target images, register photographs, and measure the similarity of images."""
