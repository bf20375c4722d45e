"""Emulated motor controllers and media, sans-I/O: frames and time in, frames out."""
