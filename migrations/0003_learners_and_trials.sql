-- Learners, by the name that a client gave them. `definition` is the canonical text that `hash` (SHA-256) is of. One that is
-- registered anew under the name of a deleted one is another learner.
CREATE TABLE learners (
    sequence       INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    name           TEXT    NOT NULL UNIQUE,
    hash           TEXT    NOT NULL,
    definition     TEXT    NOT NULL, -- JSON
    created_at_ms  INTEGER NOT NULL  -- since 1970, UTC
) STRICT;

-- Trials, in the order in which they became durable. What became of one follows from this row, `rewards` and `weights`.
CREATE TABLE trials (
    sequence             INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    id                   TEXT    NOT NULL UNIQUE,
    learner              INTEGER NOT NULL REFERENCES learners (sequence) ON DELETE CASCADE,
    number               INTEGER NOT NULL, -- with the learner's seed, what the draw is keyed by
    weights              TEXT    NOT NULL, -- JSON: as drawn, in the order of the learner's attributes
    weights_version      INTEGER NOT NULL, -- that they were drawn from
    policy_id            TEXT    NOT NULL,
    lease_expires_at_ms  INTEGER NOT NULL,
    is_failed            INTEGER NOT NULL DEFAULT 0,
    fail_reason          TEXT,
    created_at_ms        INTEGER NOT NULL,
    UNIQUE (learner, number)
) STRICT;

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
