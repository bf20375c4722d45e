"""The rig: media, controllers, motors and a runtime from one file."""
