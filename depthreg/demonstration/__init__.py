"""What `depthreg demo` serves: examples, an answer to two files, and the page that shows it."""
