// The graph of pairs: scans on a ring, trusted pairs as lines, distrusted ones dashed.

function pairTitle(pair) {
  const trust = pair.weight > 0.5 ? "trusted" : "not trusted";
  return `${DATA.scans[pair.i].name} – ${DATA.scans[pair.j].name}: overlap ` +
    `${number(pair.overlap, 2)}, weight ${number(pair.weight, 2)}, ${trust}`;
}

function samePair(pair) {
  return state.only && state.only[0] === pair.i && state.only[1] === pair.j;
}

// The pair of two scans, and whether the final poses join them.
function pairOf([i, j]) {
  const [a, b] = [DATA.scans[i].component, DATA.scans[j].component];
  return { joined: a >= 0 && a === b, component: a };
}

function showPair(pair) {
  if (samePair(pair)) return change({ only: null });
  const only = [pair.i, pair.j];
  const { joined, component } = pairOf(only);
  // Scans that the poses do not join are shown as the pair alone would have them.
  change({ only, own: !joined, when: "after", ...(joined ? { model: component } : {}) });
}

function ring() {
  const [size, radius, middle] = [480, 160, 240];
  const v = DATA.scans.length;
  const place = (i, r) => {
    const angle = (2 * Math.PI * i) / v - Math.PI / 2;
    return [middle + r * Math.cos(angle), middle + r * Math.sin(angle)];
  };
  const root = svg("svg", { viewBox: `0 0 ${size} ${size}`, role: "img", "aria-label": "Graph of pairs" });
  const edges = [...DATA.pairs].sort((a, b) => a.weight - b.weight).map((pair) => {
    const trusted = pair.weight > 0.5;
    const [a, b] = [place(pair.i, radius), place(pair.j, radius)];
    const pull = (k) => middle + 0.25 * (a[k] + b[k] - 2 * middle);
    const d = `M${a[0]} ${a[1]}Q${pull(0)} ${pull(1)} ${b[0]} ${b[1]}`;
    const group = svg("g", { class: trusted ? "edge" : "edge off", tabindex: 0, role: "button" });
    const opacity = trusted ? 0.35 + 0.65 * Math.min(pair.overlap, 1) : 0.55;
    const width = trusted ? 0.8 + 3.4 * pair.overlap * pair.weight : 1;
    const title = svg("title");
    title.textContent = pairTitle(pair);
    group.append(title, svg("path", { class: "ink", d, "stroke-width": width, opacity }),
      svg("path", { class: "hit", d }));
    group.addEventListener("click", () => showPair(pair));
    group.addEventListener("keydown", (e) => { if (e.key === "Enter") showPair(pair); });
    root.append(group);
    return [group, pair];
  });
  DATA.scans.forEach((scan, i) => {
    const [x, y] = place(i, radius);
    const dot = svg("circle", { cx: x, cy: y, r: v > 40 ? 4 : 7, fill: rgb(scan.color) });
    const title = svg("title");
    title.textContent = scan.name;
    dot.append(title);
    root.append(dot);
    if (v > 40) return;
    const [tx, ty] = place(i, radius + 15);
    const side = Math.abs(tx - middle) < 20 ? "middle" : tx < middle ? "end" : "start";
    const label = svg("text", { x: tx, y: ty + 4, "text-anchor": side });
    label.textContent = scan.name.length > 10 ? `${scan.name.slice(0, 9)}…` : scan.name;
    root.append(label);
  });
  $("ring").append(root);
  listeners.push(() => edges.forEach(([g, pair]) => g.classList.toggle("on", Boolean(samePair(pair)))));
}

function startPairs() {
  $("pairs-card").hidden = false;
  const trusted = DATA.pairs.filter((p) => p.weight > 0.5).length;
  $("pairs-note").textContent =
    `${trusted} of ${DATA.pairs.length} trusted (solid), the others dashed. ` +
    "A click shows the two scans alone.";
  if (DATA.scans.length > 2 && DATA.scans.length <= 120) ring();
  const rows = [...DATA.pairs].sort((a, b) => b.weight - a.weight || b.overlap - a.overlap);
  $("pairs-table").append(table(["pair", "overlap", "weight", inFine("inlier RMSE"), inFine("off by"), "off by [°]"],
    rows.slice(0, 500).map((p) => ({
      cells: [`${DATA.scans[p.i].name} – ${DATA.scans[p.j].name}`, p.overlap.toFixed(2),
        p.weight.toFixed(2), fine(p.rmse, 3), fine(p.distance, 3), fixed(degrees(p.angle), 3)],
      onclick: () => showPair(p),
    }))));
}
