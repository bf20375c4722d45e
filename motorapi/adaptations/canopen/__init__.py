"""CANopen client services that all CANopen adaptations share."""
