"""The printer as an optical element for your own programs: free levels go in, a modulated wave comes out."""
