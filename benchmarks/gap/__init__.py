"""The design-to-manufacturing gap at the paper's size: six arms, three tasks, judged by the virtual fab."""
