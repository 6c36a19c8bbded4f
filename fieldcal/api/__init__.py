"""What `import fieldcal` offers, a module for each kind of result; the command line is made of it."""
