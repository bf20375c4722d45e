"""A servo with Dynamixel Protocol 2.0 and a control table, as the X series by Robotis."""
