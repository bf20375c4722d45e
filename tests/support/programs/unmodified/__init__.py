"""Programs for hardware, which know nothing of motorhil."""
