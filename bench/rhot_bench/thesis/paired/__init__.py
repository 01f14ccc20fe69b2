"""The paired methods: triangulation and the 2018 disparity law."""
