-- All tables. Times are milliseconds since 1970, UTC.

-- "etud": says whose the file is.
PRAGMA application_id = 1702131044;

-- What holds for the service as a whole. One row.
CREATE TABLE service (
    id                 INTEGER NOT NULL PRIMARY KEY CHECK (id = 1),
    last_alive_ms      INTEGER,          -- when it was last known to be alive, so that time in which it was not does not count
    down_ms            INTEGER NOT NULL, -- for how long it was not, in all: its own time is that of the day less this
    models_generation  INTEGER NOT NULL  -- counts registrations and deletions of models
) STRICT;

INSERT INTO service (id, last_alive_ms, down_ms, models_generation) VALUES (1, NULL, 0, 1);

-- Models, by the name that a client gave them. `hash` is SHA-256 of the canonical text of the definition.
CREATE TABLE models (
    name           TEXT    NOT NULL PRIMARY KEY,
    hash           TEXT    NOT NULL,
    definition     TEXT    NOT NULL, -- the canonical text, unless it is in pieces; then empty
    definition_id  INTEGER,          -- of a text in pieces, and of what a model of experience was told
    definition_hash TEXT,            -- of a model of experience: SHA-256 of the canonical text; `hash` is one over that and all batches
    attributes     TEXT    NOT NULL, -- JSON
    actions        TEXT    NOT NULL, -- JSON
    n_states       INTEGER NOT NULL, -- 0: the model is searched lazily, unless it is one of experience
    n_transitions  INTEGER NOT NULL,
    n_unsafe       INTEGER NOT NULL,
    n_stochastic   INTEGER NOT NULL, -- of how many states and actions there are several outcomes
    created_at_ms  INTEGER NOT NULL
) STRICT;

CREATE INDEX models_by_definition ON models (definition_id) WHERE definition_id IS NOT NULL;

-- Definitions that are too large for a column: their canonical text in pieces, each compressed by itself (zstd). Pieces are
-- stored one by one, and belong to no model until all of them are; those that belong to none are removed.
CREATE TABLE definitions (
    id             INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT
) STRICT;

CREATE TABLE definition_pieces (
    definition_id  INTEGER NOT NULL,
    seq            INTEGER NOT NULL, -- from 0
    piece          BLOB    NOT NULL,
    PRIMARY KEY (definition_id, seq)
) STRICT;

-- What models of experience were told, in the order in which it was accepted. Rows are only ever added, until the model is gone. What is
-- experienced is folded from here.
CREATE TABLE batches (
    definition_id  INTEGER NOT NULL,
    seq            INTEGER NOT NULL, -- from 1
    batch          TEXT    NOT NULL, -- as the client calls it
    content_hash   TEXT    NOT NULL, -- SHA-256 of the batch's canonical text
    hash           TEXT    NOT NULL, -- of the model with it: SHA-256 of the model's hash before, and of the text
    n_states       INTEGER NOT NULL, -- of the model with it, and so the next three
    n_transitions  INTEGER NOT NULL,
    n_unsafe       INTEGER NOT NULL,
    n_stochastic   INTEGER NOT NULL,
    content        BLOB    NOT NULL, -- the text, compressed (zstd)
    UNIQUE (definition_id, seq),
    UNIQUE (definition_id, batch)
) STRICT;

CREATE INDEX batches_by_hash ON batches (hash);

-- What models of experience were told up to some batch, counted, in pieces: so that these need not be counted again. All of it follows
-- from the batches, and any of it may be missing; it counts if all of its pieces are there.
CREATE TABLE tallies (
    definition_id  INTEGER NOT NULL,
    seq            INTEGER NOT NULL, -- of the last batch that is counted
    piece          INTEGER NOT NULL, -- from 0
    n_pieces       INTEGER NOT NULL,
    hash           TEXT    NOT NULL, -- of the model with that batch
    checksum       INTEGER NOT NULL, -- CRC-32 of the whole, before it was compressed
    content        BLOB    NOT NULL, -- the whole (postcard), compressed (zstd) and cut
    PRIMARY KEY (definition_id, seq, piece)
) STRICT;

-- Policies, in the order in which they became durable. A policy outlives its model.
CREATE TABLE policies (
    sequence       INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    id             TEXT    NOT NULL UNIQUE,
    model          TEXT    NOT NULL, -- as in the summary, and so the next two: what lists are filtered by
    learner        TEXT,
    status         TEXT    NOT NULL,
    summary        TEXT    NOT NULL, -- JSON: the policy without its steps
    steps          BLOB    NOT NULL, -- the steps in short (postcard), from which their costs follow
    checksum       INTEGER NOT NULL, -- CRC-32 of the summary (high half) and of the steps (low half)
    refined_by     TEXT,             -- the id of the policy that refines it
    created_at_ms  INTEGER NOT NULL
) STRICT;

CREATE INDEX policies_by_model ON policies (model);
CREATE INDEX policies_by_learner ON policies (learner) WHERE learner IS NOT NULL;
CREATE INDEX policies_by_status ON policies (status);

-- Keys that clients gave their requests, with what each request has made: sent again, it is answered alike. Kept for a day.
CREATE TABLE request_keys (
    sequence       INTEGER NOT NULL PRIMARY KEY,
    scope          TEXT    NOT NULL, -- what is asked for: `policies`, or `trials of` a learner, by its sequence number
    key            TEXT    NOT NULL,
    body_hash      TEXT    NOT NULL, -- SHA-256 of the request's body
    made_id        TEXT    NOT NULL, -- of the policy or the trial
    created_at_ms  INTEGER NOT NULL,
    UNIQUE (scope, key)
) STRICT;

CREATE INDEX request_keys_by_made ON request_keys (made_id);
CREATE INDEX request_keys_by_age ON request_keys (created_at_ms);

-- Policies that a finite lookahead decided and that wait to be refined to the global optimum.
CREATE TABLE refinements (
    policy_id   TEXT    NOT NULL PRIMARY KEY,
    model_hash  TEXT    NOT NULL,
    session_id  TEXT,                        -- whose observations are the demonstration; NULL: the request has it
    request     TEXT    NOT NULL,            -- JSON: the request for the refined policy
    attempts    INTEGER NOT NULL DEFAULT 0   -- how often it was taken up; what has ended the process each time is given up
) STRICT;

-- Streams. Of a session, what it was opened with, the observations, and what was decided by time are kept; all else follows from them.
CREATE TABLE sessions (
    sequence        INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    id              TEXT    NOT NULL UNIQUE,
    model           TEXT    NOT NULL,
    model_hash      TEXT    NOT NULL,
    weights         TEXT    NOT NULL, -- JSON: by attribute
    lookahead       INTEGER,          -- NULL: only proven steps are committed before the end
    lookahead_ms    INTEGER,          -- how long a step may wait after its observation came; NULL: as long as the lookahead lets it
    observe         TEXT,             -- JSON: how observations follow from states in another vocabulary; NULL: they are the states
    conditions      TEXT    NOT NULL, -- JSON: start states, weights of observations and of the end, what the body lacks; defaults are left out
    learner         TEXT,             -- whose weights are used, if any
    weights_version INTEGER,          -- of that learner
    trial_id        TEXT,             -- the trial that is explored, if any
    status          TEXT    NOT NULL CHECK (status IN ('open', 'done', 'expired')),
    owner           INTEGER NOT NULL, -- counts who has opened or resumed it; only the newest one may add to it or end it
    n_observations  INTEGER NOT NULL,
    policy_id       TEXT,
    created_at_ms   INTEGER NOT NULL,
    active_at_ms    INTEGER NOT NULL
) STRICT;

CREATE INDEX sessions_by_activity ON sessions (active_at_ms) WHERE status = 'open';
CREATE INDEX sessions_by_time ON sessions (sequence) WHERE status = 'open' AND lookahead_ms IS NOT NULL;
CREATE INDEX sessions_by_model ON sessions (model);
CREATE INDEX sessions_by_status ON sessions (status);
CREATE INDEX sessions_by_policy ON sessions (policy_id) WHERE policy_id IS NOT NULL;
CREATE INDEX sessions_by_trial ON sessions (trial_id) WHERE trial_id IS NOT NULL;

-- Observations as they came, several a row. `states` is a JSON array of `n_states` states, the first of which is the
-- observation `seq`. A number among them is the weight of the next one, if that was given.
CREATE TABLE observations (
    session_id  TEXT    NOT NULL,
    seq         INTEGER NOT NULL,
    n_states    INTEGER NOT NULL,
    states      TEXT    NOT NULL,
    times       TEXT,             -- JSON, where steps wait for so long at most: [[seq, ms], ..], when observations came from seq on, in the service's own time
    PRIMARY KEY (session_id, seq)
) STRICT, WITHOUT ROWID;

-- Steps that sessions have committed, several a row, and in `roots` what the mapping goes on from after them. They are written along with
-- observations that come later; at once, where time has decided. What is not written yet follows from the last row and the observations.
CREATE TABLE steps (
    session_id  TEXT    NOT NULL,
    first_step  INTEGER NOT NULL,
    steps       BLOB    NOT NULL, -- in short (postcard)
    PRIMARY KEY (session_id, first_step)
) STRICT, WITHOUT ROWID;

CREATE TABLE roots (
    session_id  TEXT    NOT NULL PRIMARY KEY,
    root        BLOB    NOT NULL  -- after the last of the session's rows of steps (postcard)
) STRICT, WITHOUT ROWID;

-- Observations and steps that are durable and not yet in their tables. One row holds what a commit of the writer brought, whichever
-- sessions it is of: JSON, an array of [session_id, seq, n_states, states, at_ms], in the order in which they came, with a sixth item where
-- times are kept: when they came in the service's own time, in milliseconds. Now and then, and before anybody reads observations, everything
-- here moves to `observations` and `steps`, and is counted in `sessions`.
CREATE TABLE arrivals (
    sequence     INTEGER NOT NULL PRIMARY KEY,
    observations TEXT    NOT NULL,
    steps        BLOB              -- session_id, first_step, steps and root of each that came with them (postcard), if any did
) STRICT;

-- Learners, by the name that a client gave them. `definition` is the canonical text that `hash` (SHA-256) is of. One that is
-- registered anew under the name of a deleted one is another learner.
CREATE TABLE learners (
    sequence       INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    name           TEXT    NOT NULL UNIQUE,
    hash           TEXT    NOT NULL,
    definition     TEXT    NOT NULL,            -- JSON
    has_pending    INTEGER NOT NULL DEFAULT 0,  -- whether there are rewards that no version of the weights has folded in
    deleted_number INTEGER NOT NULL DEFAULT 0,  -- the highest number of its trials that were deleted: it is not given out again
    created_at_ms  INTEGER NOT NULL
) STRICT;

CREATE INDEX learners_with_pending ON learners (sequence) WHERE has_pending = 1;

-- Trials, in the order in which they became durable. What became of one follows from this row, `rewards` and `weights`.
CREATE TABLE trials (
    sequence             INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    id                   TEXT    NOT NULL UNIQUE,
    learner              INTEGER NOT NULL REFERENCES learners (sequence) ON DELETE CASCADE,
    number               INTEGER NOT NULL, -- with the learner's seed, what the draw is keyed by; nobody else's
    weights              TEXT    NOT NULL, -- JSON: as drawn, by attribute
    weights_version      INTEGER NOT NULL, -- that they were drawn from
    policy_id            TEXT    NOT NULL,
    lease_expires_at_ms  INTEGER NOT NULL,
    is_failed            INTEGER NOT NULL DEFAULT 0,
    fail_reason          TEXT,
    created_at_ms        INTEGER NOT NULL,
    UNIQUE (learner, number)
) STRICT;

CREATE INDEX trials_by_policy ON trials (policy_id);

-- The log of accepted rewards, numbered per learner. Rows are only ever added.
CREATE TABLE rewards (
    learner         INTEGER NOT NULL REFERENCES learners (sequence) ON DELETE CASCADE,
    reward_order    INTEGER NOT NULL,
    trial           INTEGER NOT NULL UNIQUE REFERENCES trials (sequence) ON DELETE CASCADE,
    reward          REAL    NOT NULL,
    accepted_at_ms  INTEGER NOT NULL,
    PRIMARY KEY (learner, reward_order)
) STRICT, WITHOUT ROWID;

-- Every version of a learner's distribution: the fold over the rewards up to and including `reward_order`. Version 0 is what
-- it starts from, at order 0.
CREATE TABLE weights (
    learner          INTEGER NOT NULL REFERENCES learners (sequence) ON DELETE CASCADE,
    version          INTEGER NOT NULL,
    reward_order     INTEGER NOT NULL,
    expected_reward  REAL,
    mean             TEXT    NOT NULL, -- JSON, in the order of the learner's attributes
    sd               TEXT    NOT NULL, -- JSON, likewise
    updated_at_ms    INTEGER NOT NULL,
    PRIMARY KEY (learner, version),
    UNIQUE (learner, reward_order)
) STRICT, WITHOUT ROWID;
