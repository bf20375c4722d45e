"""What a drive moves: motor, gear, load and encoder as physics. No firmware, no clock."""
