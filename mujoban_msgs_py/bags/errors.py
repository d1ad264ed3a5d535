"""What is raised about bags."""


class BagError(ValueError):
    """A bag cannot be read or written: it names the bag, what is wrong and what was expected."""
