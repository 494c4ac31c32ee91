"""Views and checks over the catalog, one question a file; a package so that wheels carry it."""
