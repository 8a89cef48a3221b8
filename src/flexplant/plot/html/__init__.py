"""The parts of the HTML report: its page, its pictures, mode shapes that move."""
