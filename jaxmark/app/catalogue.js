"use strict";
// What comes from the catalogue or a file is shown as text, never as markup.
const place = (name) => document.getElementById(name);
const make = (kind, text, ...children) => {
  const element = document.createElement(kind);
  if (text !== null) element.textContent = text;
  element.append(...children);
  return element;
};
const picture = (id) => {
  const image = make("img", null);
  if (Number.isInteger(id)) image.src = `thumbnails/${id}`;
  image.alt = "";
  return image;
};
const power = (value) => `10^${(Math.ceil(value * 10 - 1e-9) / 10).toFixed(1)}`;
const text = (hexadecimal) => {
  try {
    const bytes = Uint8Array.from(hexadecimal.match(/../g), (pair) => parseInt(pair, 16));
    const found = new TextDecoder("utf-8", { fatal: true }).decode(bytes);
    return /^[\p{L}\p{N}\p{P}\p{S} ]+$/u.test(found) ? `${hexadecimal} ("${found}")` : hexadecimal;
  } catch { return hexadecimal; }
};
const said = (match) =>
  match.recipient ? `copy for ${match.accused.join(", ")}` : match.message ? `message ${text(match.message)}` :
  match.named ? "a mark" : match.refused || "nothing";

let shown = 0;
async function list() {
  const found = await (await fetch(`originals?start=${shown}`)).json();
  if (found.refused) { place("count").textContent = found.refused; return; }
  shown += found.originals.length;
  place("count").textContent = `${found.count} originals`;
  for (const one of found.originals) {
    const held = `${one.vertices} vertices, ${one.records} records, ${one.recipients} recipients`;
    place("originals").append(make("figure", null, picture(one.id), make("figcaption", `${one.id}  ${one.name}: ${held}`)));
  }
  place("more").hidden = shown >= found.count;
}

function show(found) {
  const verdict = place("verdict");
  verdict.replaceChildren();
  if (found.refused) { verdict.append(make("p", found.refused)); return; }
  const named = found.matches.filter((match) => match.named);
  const head = named.length ? named.map((match) => `${match.original}: ${said(match)}`).join("; ") : "Nobody's";
  const box = make("div", null, make("b", head));
  box.className = "key";
  if (named.length) {
    box.append(make("p", `Such a naming would come about by chance with a probability of at most ${power(found.log10_p)}, if `
      + "keys, originals and records were fixed before the file existed; "
      + `${power(found.log10_p_uncommitted)} if nothing dates them. All ${found.readings} readings that could have been made are paid for.`));
  }
  if (found.dossier) {
    const link = make("a", "Dossier");
    link.href = `dossiers/${found.dossier}`;
    box.append(make("p", null, link, ` (of this original alone: its figures do not pay for the other ${found.readings - 1} readings)`));
  }
  const rows = found.matches.map((match) => make("tr", null,
    make("td", null, picture(match.id)), make("td", match.original), make("td", `${match.by}, rank ${match.rank}`),
    make("td", said(match)), make("td", power(match.log10_p))));
  const titles = ["", "original", "looked like", "found", "probability"].map((title) => make("th", title));
  verdict.append(box, make("table", null, make("tr", null, ...titles), ...rows));
}

async function find(file) {
  show({ refused: `Looking for ${file.name} …` });
  try {
    const sent = { method: "POST", headers: { "x-jaxmark": "find" }, body: file };
    show(await (await fetch(`find?name=${encodeURIComponent(file.name)}`, sent)).json());
  } catch (error) {
    show({ refused: `No answer: ${error.message}` });
  }
}

const drop = place("drop");
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    drop.classList.toggle("over", kind === "dragover");
    if (kind === "drop" && event.dataTransfer.files.length) find(event.dataTransfer.files[0]);
  });
}
place("file").addEventListener("change", (event) => event.target.files.length && find(event.target.files[0]));
place("more").addEventListener("click", list);
list();
