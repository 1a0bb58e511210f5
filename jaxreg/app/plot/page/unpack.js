// What the page holds as gzip in base64: its data, and the library that draws.

async function unpacked(id) {
  const node = document.getElementById(id);
  const bytes = Uint8Array.from(atob(node.textContent), (c) => c.charCodeAt(0));
  node.remove();
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

if (!("DecompressionStream" in window)) {
  const advice = document.getElementById("advice");
  advice.textContent = "This browser cannot unpack the page: open it in one of 2023 or later.";
  advice.hidden = false;
}
const library = document.createElement("script");
library.textContent = await unpacked("plotly");
document.head.append(library);
