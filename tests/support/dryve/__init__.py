"""Support for tests of the igus dryve D1."""
