"""Make reports: HTML pages, their pictures, and copies of figures and tables for papers."""
