// How far each relative motion is from what the final poses say of it.

function residualRows() {
  if (SCANS) {
    return DATA.pairs.filter((p) => p.angle !== null).map((p) => ({
      angle: p.angle, distance: p.distance, trusted: p.weight > 0.5,
      name: pairTitle(p), click: () => showPair(p),
    }));
  }
  const [angle, distance, weight] = [DATA.angle, DATA.distance, DATA.weight].map((x) => decode(x, Float32Array));
  const edges = decode(DATA.edges, Int32Array);
  return Array.from(weight, (w, e) => {
    const [i, j] = [edges[2 * e], edges[2 * e + 1]];
    return { angle: angle[e], distance: distance[e], trusted: w > 0.5,
      name: `${DATA.names[i] ?? i} – ${DATA.names[j] ?? j}: weight ${number(w, 3)}`,
      click: () => change({ edge: state.edge && state.edge.i === i && state.edge.j === j ? null : { i, j, w } }) };
  });
}

// Zero has no place on a scale of powers: it is drawn where the digits end.
function shownAs(values) {
  const above = values.filter((x) => x > 0);
  const least = above.length ? above.reduce((a, b) => Math.min(a, b)) : 1e-9;
  return values.map((x) => Math.max(x, least));
}

function kernelLines() {
  const width = SCANS ? [null, null] : DATA.kernel_width;
  if (width[0] === null) return [];
  const line = { color: theme("--soft"), width: 1.5, dash: "dash" };
  const [x, y] = [width[0], degrees(width[1])];
  return [
    { type: "line", x0: x, x1: x, yref: "paper", y0: 0, y1: 1, line },
    { type: "line", y0: y, y1: y, xref: "paper", x0: 0, x1: 1, line },
  ];
}

function startResiduals() {
  const rows = residualRows();
  if (rows.length < 3) return;
  $("residual-card").hidden = false;
  const lines = kernelLines();
  $("residual-title").textContent = lines.length ? "Residuals and kernel width" : "Residuals";
  $("residual-note").textContent = "How far each pair is from what the final poses say of it. " +
    (lines.length ? "Dashed: the final width of the kernel, beyond which edges count little. " : "") +
    "A click shows the pair.";
  const [x, y] = [shownAs(rows.map((r) => r.distance)), shownAs(rows.map((r) => degrees(r.angle)))];
  const draw = () => {
    const traces = [true, false].map((trusted) => {
      const ids = rows.map((_, k) => k).filter((k) => rows[k].trusted === trusted);
      return {
        type: "scattergl", mode: "markers", name: `${trusted ? "trusted" : "not trusted"} (${ids.length})`,
        x: ids.map((k) => x[k]), y: ids.map((k) => y[k]), customdata: ids,
        text: ids.map((k) => rows[k].name), hoverinfo: "text",
        marker: { size: rows.length > 500 ? 4 : 7, opacity: 0.7, color: theme(trusted ? "--good" : "--bad") },
      };
    });
    const axis = (text) => ({ type: "log", title: { text }, gridcolor: theme("--line"), zeroline: false,
      exponentformat: "power", dtick: 1 });
    return Plotly.react("residuals", traces, {
      margin: { l: 56, r: 10, t: 6, b: 44 }, shapes: lines, hovermode: "closest",
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: theme("--soft"), size: 11 }, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
      xaxis: axis(`distance [${UNIT || "unit of the input"}]`), yaxis: axis("angle [°]"),
    }, { ...CONFIG, scrollZoom: false });
  };
  draw();
  $("residuals").on("plotly_click", (event) => rows[event.points[0].customdata].click());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}
