"""What leaves the home: views as files, catalogs for one reader."""
