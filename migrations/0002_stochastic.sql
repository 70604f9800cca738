-- Of how many states and actions of a model there are several outcomes. Models from before have none.
ALTER TABLE models ADD COLUMN n_stochastic INTEGER NOT NULL DEFAULT 0;
