// English texts, by file of the page. `{name}` is replaced by a value; see texts.js.

export default {
  // verdicts
  "verdict.mine_like": "mine-like",
  "verdict.not_mine_like": "not mine-like",
  "verdict.unsure": "unsure",
  "verdict.unreviewed": "unreviewed",
};
