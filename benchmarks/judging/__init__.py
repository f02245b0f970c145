"""What the released model is judged by, on real frames: readers, one file for each kind of row, the table, pictures."""
