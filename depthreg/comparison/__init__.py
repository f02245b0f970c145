"""What `depthreg compare` is made of: runs read from disk, rows of them, tables, curves, pictures, the page."""
