// The main view of an averaged graph: positions and edges, before and after.

const KINDS = [
  ["chain", "Edges along the path", "--accent", 2],
  ["loops", "Other edges, trusted", "--good", 1.5],
  ["off", "Edges not trusted", "--bad", 1.5],
];
let GRAPH = null;

function readGraph() {
  const [edges, weight] = [decode(DATA.edges, Int32Array), decode(DATA.weight, Float32Array)];
  const placed = decode(DATA.placed, Uint8Array);
  const kinds = { chain: [], loops: [], off: [] };
  weight.forEach((w, e) => {
    const [i, j] = [edges[2 * e], edges[2 * e + 1]];
    if (!placed[i] || !placed[j]) return;
    kinds[w <= 0.5 ? "off" : Math.abs(i - j) === 1 ? "chain" : "loops"].push([i, j]);
  });
  return { kinds, before: decode(DATA.before, Float32Array), after: decode(DATA.after, Float32Array) };
}

function graphTraces() {
  const at = GRAPH[state.when];
  const d = DATA.dim;
  return KINDS.map(([kind, , color, width]) => {
    const axes = Array.from({ length: d }, () => []);
    for (const [i, j] of GRAPH.kinds[kind]) {
      // One line with gaps is much faster than thousands of lines.
      for (let a = 0; a < d; a++) axes[a].push(at[i * d + a], at[j * d + a], null);
    }
    return {
      type: FLAT ? "scattergl" : "scatter3d", mode: "lines",
      x: axes[0], y: axes[1], ...(FLAT ? {} : { z: axes[2] }),
      line: { color: theme(color), width: FLAT ? width : 2 * width },
      hoverinfo: "skip", showlegend: false, visible: state.shown[kind],
    };
  });
}

function graphLayout() {
  const base = {
    margin: { l: 8, r: 8, t: 8, b: 8 }, uirevision: state.when,
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
  };
  const axis = { visible: false };
  if (FLAT) return { ...base, dragmode: "pan", xaxis: axis, yaxis: { ...axis, scaleanchor: "x" } };
  return { ...base, scene: { xaxis: axis, yaxis: axis, zaxis: axis, aspectmode: "data",
    dragmode: "orbit", camera: { eye: { x: 0.9, y: -1.3, z: 1.1 } }, bgcolor: "rgba(0,0,0,0)" } };
}

function startGraph() {
  GRAPH = readGraph();
  choice("when", [["before", "Before"], ["after", "After"]], "when");
  $("color").remove();
  $("home").addEventListener("click", () => Plotly.newPlot("scene", graphTraces(), graphLayout(), CONFIG));
  $("hint").textContent = FLAT ? "Drag to move, wheel to zoom."
    : "Drag to turn, wheel to zoom, right button to move.";
  $("list-title").textContent = "Edges";
  for (const [kind, label, color] of KINDS) {
    const box = el("input", { type: "checkbox" });
    box.checked = true;
    box.addEventListener("change", () => change({ shown: { ...state.shown, [kind]: box.checked } }));
    $("list").append(el("label", { class: "row" }, box,
      el("span", { class: "dot", style: `background:var(${color})` }),
      el("span", { class: "name" }, label),
      el("small", {}, GRAPH.kinds[kind].length.toLocaleString("en"))));
  }
  listeners.push(() => Plotly.react("scene", graphTraces(), graphLayout(), CONFIG));
  return Plotly.newPlot("scene", graphTraces(), graphLayout(), CONFIG);
}
