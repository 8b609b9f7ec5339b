"use strict";
// Frames as the program packs them (see message.py), from the server or out of the page itself.

function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const frame = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const types = { f4: Float32Array, i4: Int32Array, u4: Uint32Array, u1: Uint8Array };
  const arrays = {};
  for (const [name, { type, shape, offset }] of Object.entries(frame.arrays)) {
    const count = shape.reduce((product, side) => product * side, 1);
    arrays[name] = new types[type](buffer, 4 + length + offset, count);
  }
  frame.arrays = arrays;
  return frame;
}

// What is shown comes from a server at the page's own address.
class ServedFrames {
  async about() {
    return (await this.#get("about")).json();
  }

  // Fields by name, every `step`-th pixel.
  async frame(place, names, step) {
    const response = await this.#get(`frame/${place}?fields=${names.join(",")}&step=${step}`);
    return unpack(await response.arrayBuffer());
  }

  // The next live frame after one; null: none has come for some seconds.
  async next(after, names, step) {
    const response = await this.#get(`live?after=${after}&fields=${names.join(",")}&step=${step}`);
    return response.status === 204 ? null : unpack(await response.arrayBuffer());
  }

  async #get(address) {
    let response;
    try {
      response = await fetch(address);
    } catch {
      throw new Error("the program that shows this has ended: start colorphase view again");
    }
    if (!response.ok) throw new Error((await response.json()).error);
    return response;
  }
}

// What is shown is in the page.
class PackedFrames {
  async about() {
    return JSON.parse(document.getElementById("about").textContent);
  }

  async frame(place) {
    const text = document.getElementById(`frame-${place}`).textContent;
    const packed = new Blob([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))]);
    return unpack(await new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer());
  }
}
