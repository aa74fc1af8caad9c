"""What every part of the package uses: errors, configuration, files, code generation."""
