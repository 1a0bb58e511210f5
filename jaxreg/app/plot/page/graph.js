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
  const all = [];
  weight.forEach((w, e) => {
    const [i, j] = [edges[2 * e], edges[2 * e + 1]];
    if (!placed[i] || !placed[j]) return;
    all.push({ i, j, w });
    kinds[w <= 0.5 ? "off" : Math.abs(i - j) === 1 ? "chain" : "loops"].push([i, j]);
  });
  const used = [...new Set(all.flatMap(({ i, j }) => [i, j]))];
  const view = (text) => {
    const at = decode(text, Float32Array);
    const part = Array.from({ length: DATA.dim }, (_, a) => Float32Array.from(used, (i) => at[i * DATA.dim + a]));
    const box = part.map((x) => [x.reduce((a, b) => Math.min(a, b)), x.reduce((a, b) => Math.max(a, b))]);
    return { at, parts: [part], box, origin: DATA.origin };
  };
  all.sort((a, b) => a.w - b.w);
  return { kinds, weakest: all.slice(0, 14), before: view(DATA.before), after: view(DATA.after) };
}

function graphTraces() {
  const { at } = GRAPH[state.when];
  const d = DATA.dim;
  const picked = state.edge ? [[state.edge.i, state.edge.j]] : [];
  const layers = KINDS.map(([kind, , color, width]) => [GRAPH.kinds[kind], color, width, state.shown[kind]]);
  layers.push([picked, "--ink", 5, picked.length > 0]);
  const traces = layers.map(([edges, color, width, visible]) => {
    const axes = Array.from({ length: d }, () => []);
    for (const [i, j] of edges) {
      // One line with gaps is much faster than thousands of lines.
      for (let a = 0; a < d; a++) axes[a].push(at[i * d + a], at[j * d + a], null);
    }
    return {
      type: FLAT ? "scattergl" : "scatter3d", mode: "lines",
      x: axes[0], y: axes[1], ...(FLAT ? {} : { z: axes[2] }),
      line: { color: theme(color), width: FLAT ? width : 2 * width },
      hoverinfo: "skip", showlegend: false, visible,
    };
  });
  return [...traces, ...markTraces(GRAPH[state.when])];
}

function graphLayout() { return sceneLayout(GRAPH[state.when], GRAPH.after); }

// The edges that agree least with the poses; a click draws one thick.
function weakest() {
  if (!GRAPH.weakest.length) return;
  const box = $("modes");
  box.hidden = false;
  box.append(el("h2", {}, "Least trusted edges"), el("p", { class: "note" }, "Weight from 0 to 1; a click shows the edge."));
  for (const edge of GRAPH.weakest) {
    const row = el("button", { type: "button", class: "row" },
      el("span", { class: "name" }, `${DATA.names[edge.i]} – ${DATA.names[edge.j]}`),
      el("small", {}, edge.w.toFixed(3)));
    row.addEventListener("click", () => change({ edge: state.edge === edge ? null : edge }));
    listeners.push(() => row.setAttribute("aria-pressed", String(state.edge === edge)));
    box.append(row);
  }
}

function startGraph() {
  GRAPH = readGraph();
  choice("when", [["before", "Before"], ["after", "After"]], "when");
  $("color").remove();
  $("home").addEventListener("click", () => Plotly.newPlot("scene", graphTraces(), graphLayout(), CONFIG));
  $("hint").textContent = howToMove() + markHint(GRAPH.after);
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
  markList();
  weakest();
  listeners.push(() => Plotly.react("scene", graphTraces(), graphLayout(), CONFIG));
  return Plotly.newPlot("scene", graphTraces(), graphLayout(), CONFIG);
}
