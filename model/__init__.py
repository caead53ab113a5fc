"""The learned restorer, on torch and kornia. It uses the core and never meets `rainstereo.calib`."""
