"""The printer as an optical element for programs of one's own: free levels in, a modulated wave out."""
