"""Small mechanisms of the gallery: `build()` of each module returns a System, `motion()` what the picture shows."""
