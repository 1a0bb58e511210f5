// Where the middles of the scans may lie, in the main view.

// How many times as large the ellipsoids of a model are drawn as they are.
function errorScale(model) {
  const known = DATA.scans.filter((s) => s.axes && s.component === model);
  const largest = Math.max(0, ...known.flatMap((s) => s.axes.map((a) => Math.hypot(...a))));
  const { box } = arranged("after");
  const size = Math.max(...box.map(([low, high]) => high - low));
  return largest > 0 ? Number((0.06 * size / largest).toPrecision(1)) : 0;
}

// Where the middles of the scans may lie: an ellipse in each plane of two axes.
function errorOutlines() {
  const { origin } = arranged(state.when);
  const grow = state.when === "after" && !state.own ? errorScale(state.model) : 0;
  const out = Array.from({ length: DATA.dim }, () => []);
  DATA.scans.forEach(({ axes, middle }, i) => {
    if (!axes || !grow || !isShown(i)) return;
    for (let a = 0; a < DATA.dim; a++) for (let b = 0; b < a; b++) {
      for (let k = 0; k <= 24; k++) {
        const [c, s] = [Math.cos((k * Math.PI) / 12), Math.sin((k * Math.PI) / 12)];
        out.forEach((x, n) =>
          x.push(middle[n] - origin[n] + grow * (c * axes[a][n] + s * axes[b][n])));
      }
      out.forEach((x) => x.push(null));
    }
  });
  return { type: FLAT ? "scattergl" : "scatter3d", mode: "lines",
    x: out[0], y: out[1], ...(FLAT ? {} : { z: out[2] }), hoverinfo: "skip",
    showlegend: false, line: { color: theme("--ink"), width: 2 }, visible: grow > 0 };
}
