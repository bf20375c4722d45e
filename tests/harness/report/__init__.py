"""Report: its data against independent readings, and the page in a real browser."""
