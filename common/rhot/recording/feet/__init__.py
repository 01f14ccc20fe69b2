"""What a recording holds of the feet beside the depth camera's pictures: ankle sensors and the head's poses."""
