"use strict";
// All values from the catalogue or a file are inserted as text, never as markup.
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
const power = (value) => make("span", "10", make("sup", (Math.ceil(value * 10 - 1e-9) / 10).toFixed(1)));
const text = (hexadecimal) => {
  try {
    const bytes = Uint8Array.from(hexadecimal.match(/../g), (pair) => parseInt(pair, 16));
    const decoded = new TextDecoder("utf-8", { fatal: true }).decode(bytes);
    return /^[\p{L}\p{N}\p{P}\p{S} ]+$/u.test(decoded) ? `${hexadecimal} ("${decoded}")` : hexadecimal;
  } catch { return hexadecimal; }
};
const content = (match) => (match.estimate ? "estimate, not a proof: " : "") + result(match);
const result = (match) =>
  match.accused.length + match.estimates.length ? `copy for ${match.accused.concat(match.estimates).join(", ")}` : match.message ? `message ${text(match.message)}` :
  match.named || match.estimate ? "a mark" : match.refused || "nothing detected";

let listed = 0;
async function list() {
  const answer = await (await fetch(`originals?start=${listed}`)).json();
  if (answer.refused) { place("count").textContent = answer.refused; return; }
  listed += answer.originals.length;
  place("count").textContent = `${answer.count} ${answer.count === 1 ? "original" : "originals"}`;
  for (const entry of answer.originals) {
    const several = (number, name) => `${number} ${name}${number === 1 ? "" : "s"}`;
    const counts = `${entry.vertices} vertices, ${several(entry.records, "record")}, ${several(entry.recipients, "recipient")}`;
    place("originals").append(make("figure", null, picture(entry.id), make("figcaption", `${entry.id}  ${entry.name}: ${counts}`)));
  }
  place("more").hidden = listed >= answer.count;
}

function show(name, answer) {
  const verdict = place("verdict");
  verdict.replaceChildren();
  if (answer.refused) { verdict.append(make("p", answer.refused)); return; }
  const named = answer.matches.filter((match) => match.named);
  const head = named.length ? named.map((match) => `made from ${match.original}, ${content(match)}`).join("; ") : "no original is named";
  const box = make("div", null, make("b", `${name}: ${head}`));
  box.className = "key";
  if (named.length) {
    box.append(make("p", "The false-positive probability of this result is at most ", power(answer.log10_p),
      " if keys, originals, records and the list of recipients were fixed before the file existed, and at most ",
      power(answer.log10_p_uncommitted), " even if keys, originals and records were chosen afterwards. Both bounds "
      + `count all ${answer.readings} readings that could have been made.`));
  }
  if (answer.dossier) {
    const link = make("a", "Dossier");
    link.href = `dossiers/${answer.dossier}`;
    box.append(make("p", null, link, ` of this original (its bounds also count all ${answer.readings} readings)`));
  }
  const rows = answer.matches.map((match) => make("tr", null,
    make("td", null, picture(match.id)), make("td", match.original), make("td", `${match.by}, rank ${match.rank}`),
    make("td", content(match)), make("td", null, power(match.log10_p))));
  const titles = ["", "original", "similar by", "result", "false-positive probability"].map((title) => make("th", title));
  verdict.append(box, make("table", null, make("tr", null, ...titles), ...rows));
}

let latest = null;
async function find(file) {
  latest = file;
  show(file.name, { refused: `Comparing ${file.name} with the originals …` });
  let answer;
  try {
    const request = { method: "POST", headers: { "x-jaxmark": "find" }, body: file };
    answer = await (await fetch(`find?name=${encodeURIComponent(file.name)}`, request)).json();
  } catch (error) {
    answer = { refused: `The server does not answer: ${error.message}` };
  }
  if (file === latest) show(file.name, answer);  // a file that was chosen later has the place of its answer
}

const drop = place("drop");
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    drop.classList.toggle("over", kind === "dragover");
    if (kind === "drop" && event.dataTransfer.files.length) find(event.dataTransfer.files[0]);
  });
}
place("file").addEventListener("click", (event) => { event.target.value = ""; });  // the same file can be chosen again
place("file").addEventListener("change", (event) => event.target.files.length && find(event.target.files[0]));
place("more").addEventListener("click", list);
list();
