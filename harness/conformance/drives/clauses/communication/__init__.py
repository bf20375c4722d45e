"""Clauses for a CANopen node (CiA 301, CiA 305): what it sends, receives and keeps."""
