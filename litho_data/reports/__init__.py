"""Write reports: HTML pages, the pictures on them, and copies of their figures and tables for papers."""
