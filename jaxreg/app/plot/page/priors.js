// Priors of poses and levels: how far off the poses are, and whether they were used.

// "priors", "levels", or both.
function priorKinds() {
  return ["prior", "level"].filter((kind) => DATA.priors.some((p) => p.kind === kind))
    .map((kind) => `${kind}s`).join(" and ");
}

function priorsTile() {
  const all = DATA.priors.length;
  if (!all) return;
  const trusted = DATA.priors.filter((p) => p.weight > 0.5).length;
  tile(`${trusted} of ${all}`, `${priorKinds()} trusted`,
    trusted < all || DATA.priors.some(isWide) ? "warn" : "");
}

function startPriors() {
  const rows = DATA.priors;
  if (!rows.length) return;
  $("priors-card").hidden = false;
  const size = (p) => p.normalised ?? p.length ?? p.angle ?? Infinity;
  const order = [...rows].sort((p, q) => p.weight - q.weight || size(q) - size(p));
  const shown = order.slice(0, 500).map((p) => ({
    cells: [`${p.kind} ${p.number}`, frameOf(p), fine(p.length, 3), number(degrees(p.angle), 3),
      el("span", { class: isWide(p) ? "warn" : "" }, number(p.normalised, 3)), number(p.weight, 2),
      p.weight > 0.5 ? "yes" : el("span", { class: "bad" }, "no")],
  }));
  const more = rows.length > shown.length ? ` The first ${shown.length} of ${rows.length}; result.json holds all.` : "";
  $("priors-note").textContent = "How far the poses are from what was known of them; of levels, from upright. "
    + `Normalised: in standard deviations. What was not used comes first.${more}`;
  $("priors").append(table(["", SCANS ? "scan" : "frame", inFine("length"), "angle [°]",
    "normalised", "trust", "used"], shown));
}
