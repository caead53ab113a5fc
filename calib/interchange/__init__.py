"""Calibrations in other people's formats: OpenCV FileStorage, ROS camera_info and Kalibr camchain, in and out.

`source.read` recognises a file by its content and gives `Described` cameras, as they stand in it; `lens_fit` turns them
into `Camera`s and back, exactly where both know the lens, else by least squares with the loss as a figure. One module
writes and reads each format: `opencv_file`, `ros_file`, `kalibr_file`. None of them needs mrcal, except for lenses that
only mrcal computes.
"""
