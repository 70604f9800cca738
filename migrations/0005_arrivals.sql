-- Observations that are durable and not yet in their table. One row holds what a commit of the writer brought, whichever
-- sessions it is of: JSON, an array of [session_id, seq, n_states, states, at_ms], in the order in which they came. Now and
-- then, and before anybody reads observations, everything here moves to `observations` and is counted in `sessions`.
CREATE TABLE arrivals (
    sequence     INTEGER NOT NULL PRIMARY KEY,
    observations TEXT    NOT NULL
) STRICT;
