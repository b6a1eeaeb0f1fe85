"""Photos in, models out: the stages in their order, what is kept between runs, and how a run is told."""
