"""The printer as an optical element for your own programs: free levels in, a modulated wave out."""
